"""Anchors as CSV: a line of column names, then one anchor per line; empty cells are left out."""

import math
import os
from typing import Any

from helio_jax.errors import InputFileError
from helio_jax.formats.points import read_rows
from helio_jax.spelling import did_you_mean

NUMBERS = ("height_um", "length_um", "std_um", "radius_um")
PLACES = {"at_um": ("x_um", "y_um"), "from_um": ("from_x_um", "from_y_um")}
"""Columns of each place."""
WORDS = ("name", "kind", "detector")
COLUMNS = (*WORDS, *PLACES["at_um"], *PLACES["from_um"], *NUMBERS)
"""Columns that a file may have, in any order."""


def read_anchors(path: str | os.PathLike) -> list[dict[str, Any]]:
    """Read what is known of heights, as tables `[[reconstruct.anchor]]`. Lines that begin with # are ignored.

    Raises:
        InputFileError: as `read_rows`; an unknown or repeated column, no anchor, a bad number, half of a place.
    """
    (first, titles), *lines = read_rows(path, COLUMNS)
    for title in titles:
        if title not in COLUMNS:
            remedy = did_you_mean(title, COLUMNS) or f"known are {', '.join(COLUMNS)}"
            raise InputFileError(f"{path}, line {first}: there is no column {title!r}: {remedy}")
    if len(set(titles)) < len(titles):
        raise InputFileError(f"{path}, line {first}: a column is given twice, got {','.join(titles)}: remove one")
    if not lines:
        raise InputFileError(f"{path}: has titles, but no anchor: add one per line")
    return [_anchor(f"{path}, line {number}", dict(zip(titles, row, strict=True))) for number, row in lines]


def _anchor(where: str, cells: dict[str, str]) -> dict[str, Any]:
    given = {title: cell for title, cell in cells.items() if cell}
    out: dict[str, Any] = {title: given[title] for title in WORDS if title in given}
    out |= {title: _number(where, title, given[title]) for title in NUMBERS if title in given}
    for place, columns in PLACES.items():
        found = [title for title in columns if title in given]
        if len(found) == 1:
            raise InputFileError(f"{where}: a place needs {' and '.join(columns)}, got {found[0]} alone")
        if found:
            out[place] = tuple(_number(where, title, given[title]) for title in columns)
    return out


def _number(where: str, title: str, cell: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputFileError(f"{where}: {title} must be a finite number, got {cell!r}")
    return value
