"""Write tables of named columns as text (.csv) or NumPy arrays (.npz)."""

import csv
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from helio_jax.errors import SceneError
from helio_jax.formats.safe import atomic_path, check_target


def check_table_target(path: str | os.PathLike) -> str:
    """Return the suffix of a table to be written; call this before a long computation.

    Raises:
        SceneError: the suffix is neither .csv nor .npz, or the file cannot be written there.
    """
    kind = Path(path).suffix.lower()
    if kind not in (".csv", ".npz"):
        raise SceneError(f"{path}: a table is written as .csv or .npz, got {kind or 'no suffix'!r}")
    check_target(Path(path))
    return kind


def write_columns(path: str | os.PathLike, columns: Mapping[str, np.ndarray]) -> None:
    """Write columns of equal length; numbers in text are exact: as many digits as that takes.

    Raises:
        SceneError: as `check_table_target`.
    """
    kind = check_table_target(path)
    with atomic_path(path) as part:
        if kind == ".npz":
            np.savez_compressed(part, **columns)  # type: ignore[arg-type]
            return
        with part.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(columns)
            writer.writerows(zip(*(c.astype(str) for c in columns.values()), strict=True))
