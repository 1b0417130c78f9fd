"""Control points as CSV: the header `view,point,x_um,y_um`, then one point per line (beam positions, um)."""

import csv
import io
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from helio_jax.child import MIB, check_size
from helio_jax.errors import InputFileError
from helio_jax.formats.safe import atomic_path

HEADER = ["view", "point", "x_um", "y_um"]
MAX_FILE_BYTES = 4 * MIB


def read_rows(path: str | os.PathLike, titles: Sequence[str]) -> list[tuple[int, list[str]]]:
    """Read the lines of a CSV table, with their numbers, the line of titles first; all have as many columns as that.

    Blank lines and lines that begin with # are ignored, and so are spaces around a cell.

    Args:
        path: of the file.
        titles: of the columns, for messages.

    Raises:
        InputFileError: missing, too large, not UTF-8, empty, or a line with another number of columns.
    """
    check_size(path, MAX_FILE_BYTES)
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as e:
        raise InputFileError(f"{path}: is not UTF-8 text ({e.reason} at byte {e.start}): save it as UTF-8") from None
    try:
        rows = [(n, r) for n, r in enumerate(csv.reader(io.StringIO(text)), 1) if r and not r[0].startswith("#")]
    except csv.Error as e:
        raise InputFileError(f"{path}: is not a CSV table: {e}") from None
    if not rows:
        raise InputFileError(f"{path}: the first line must name columns ({','.join(titles)}), got an empty file")
    for number, row in rows:
        if len(row) != len(rows[0][1]):
            raise InputFileError(f"{path}, line {number}: must have {len(rows[0][1])} columns, got {len(row)}")
    return [(number, [cell.strip() for cell in row]) for number, row in rows]


def read_points(path: str | os.PathLike) -> dict[str, dict[str, tuple[float, float]]]:
    """Read control points: {view: {point: (x, y) [um]}}. Lines that begin with # are ignored.

    Raises:
        InputFileError: as `read_rows`; another header, a bad number, or a repeated point.
    """
    (_, titles), *lines = read_rows(path, HEADER)
    if titles != HEADER:
        raise InputFileError(f"{path}: the first line must be {','.join(HEADER)}, got {','.join(titles)[:200]}")
    picks: dict[str, dict[str, tuple[float, float]]] = {}
    for number, (view, point, *place) in lines:
        try:
            x, y = map(float, place)
        except ValueError:
            x = y = math.nan
        if not (math.isfinite(x) and math.isfinite(y)):
            raise InputFileError(
                f"{path}, line {number}: x_um and y_um must be finite numbers, got {place[0]!r}, {place[1]!r}"
            )
        if point in picks.setdefault(view, {}):
            raise InputFileError(f"{path}, line {number}: point {point!r} of view {view!r} is given twice: remove one")
        picks[view][point] = (x, y)
    return picks


def write_points(path: str | os.PathLike, picks: Mapping[str, Mapping[str, tuple[float, float]]]) -> None:
    """Write control points, replacing the file in one step."""
    with atomic_path(Path(path)) as part, part.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(HEADER)
        for view, named in picks.items():
            writer.writerows([view, point, f"{x:.3f}", f"{y:.3f}"] for point, (x, y) in named.items())
