"""Checked access to the contents of a foreign file: nested tables of arrays and plain values."""

import math
from typing import Any

import numpy as np

from helio_jax.errors import InputFileError


def get_table(path: str, tree: dict[str, Any], name: str) -> dict[str, Any]:
    """Return a nested table.

    Raises:
        InputFileError: missing or no table.
    """
    value = tree.get(name)
    if not isinstance(value, dict):
        raise InputFileError(f"{path}: {name} must be a table of values, got {describe_value(value)}")
    return value


def get_list(path: str, tree: dict[str, Any], name: str, length: int | None = None) -> list[Any]:
    """Return a list (a MATLAB cell array), of `length` if given.

    Raises:
        InputFileError: missing, no list, or of another length.
    """
    value = tree.get(name)
    if not isinstance(value, list) or (length is not None and len(value) != length):
        wanted = "a list" if length is None else f"a list of {length}"
        raise InputFileError(f"{path}: {name} must be {wanted}, got {describe_value(value)}")
    return value


def get_number(path: str, tree: dict[str, Any], name: str, *, low: float = -math.inf) -> float:
    """Return a finite number greater than `low`.

    Raises:
        InputFileError: missing, no number, not finite or too small.
    """
    value = tree.get(name)
    array = np.asarray(value) if isinstance(value, (int, float, np.ndarray)) else np.empty(0)
    if array.size != 1 or array.dtype.kind not in "fiub" or not np.isfinite(array).all() or array.item() <= low:
        limit = "" if low == -math.inf else f" > {low:g}"
        raise InputFileError(f"{path}: {name} must be one number{limit}, got {describe_value(value)}")
    return float(array.item())


def get_array(path: str, value: Any, name: str, ndim: int) -> np.ndarray:
    """Return a non-empty array of numbers in float64, so that small integer types cannot overflow.

    Raises:
        InputFileError: missing, not numeric, empty, or of another number of axes.
    """
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub" or value.ndim != ndim or not value.size:
        raise InputFileError(
            f"{path}: {name} must be an array of numbers with {ndim} axes, got {describe_value(value)}"
        )
    return value.astype(np.float64)


def describe_value(value: Any) -> str:
    """Describe a value in a few words, for messages."""
    if value is None:
        return "nothing"
    if isinstance(value, np.ndarray):
        return f"an array of {' x '.join(map(str, value.shape)) or 'no axes'} ({value.dtype})"
    if isinstance(value, (list, dict)):
        return f"a {'list' if isinstance(value, list) else 'table'} of {len(value)}"
    return repr(value)[:60]
