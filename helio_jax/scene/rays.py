"""Read the rays of a beam from a file: start and direction of every atom.

Lab axes, relative to the pinhole's centre; z points up, away from the sample, so directions point down. Files are
untrusted, see files.py.
"""

from pathlib import Path

import numpy as np

from helio_jax.child import call_in_child
from helio_jax.errors import InputFileError
from helio_jax.scene.files import check_file, read_arrays, read_table

MAX_RAYS_MB = 256.0
"""Largest file of rays, and largest content of an .npz after decompression."""
_COLUMNS = "x, y, z [um], x, y, z of the direction and optionally weight"


def read_rays(path: Path) -> np.ndarray:
    """Read rays: .csv (one per line, # comments), .npy [n, 6 or 7], or .npz (position, direction, weight).

    Returns:
        Position [um], unit direction and weight (default 1) of every ray [n, 7].

    Raises:
        InputFileError: as `read_bytes`; another kind of file; not numbers; other columns; a ray that starts below the
            plate or does not point down; no weight > 0.
    """
    kind = path.suffix.lower()
    if kind not in (".csv", ".npy", ".npz"):
        raise InputFileError(f"{path}: rays must be .csv, .npy or .npz, got {kind or 'no suffix'!r}")
    if kind == ".csv":
        rows = read_table(path, MAX_RAYS_MB, "a table of numbers separated by commas")
    elif kind == ".npz":
        rows = _stack(path, read_arrays(path, MAX_RAYS_MB, ("position", "direction"), ("weight",)))
    else:
        check_file(path, MAX_RAYS_MB)
        rows = call_in_child("helio_jax.scene.rays:load_npy", path)
    if rows.ndim != 2 or rows.shape[1] not in (6, 7) or not len(rows):
        raise InputFileError(f"{path}: rays need 6 or 7 columns ({_COLUMNS}), got the shape {rows.shape}")
    rows = rows if rows.shape[1] == 7 else np.column_stack([rows, np.ones(len(rows))])
    length = np.linalg.norm(rows[:, 3:6], axis=1)
    for is_wrong, what in (
        (~np.isfinite(rows).all(1), "must be finite numbers"),
        (rows[:, 2] < 0.0, "must start in the plate's plane or above it (z >= 0 um)"),
        (~(length > 0.0), "must have a direction, got a vector of length 0"),
        (~(rows[:, 5] < 0.0), "must fly down to the sample (z of the direction < 0)"),
        (rows[:, 6] < 0.0, "must have a weight >= 0"),
    ):
        if is_wrong.any():
            i = int(np.argmax(is_wrong))
            raise InputFileError(f"{path}: every ray {what}; ray {i + 1} is {rows[i].tolist()}: correct or remove it")
    if not rows[:, 6].sum() > 0.0:
        raise InputFileError(f"{path}: all {len(rows)} weights are 0: give at least one ray a weight > 0")
    rows[:, 3:6] /= length[:, None]
    return rows


def _stack(path: Path, columns: list[np.ndarray]) -> np.ndarray:
    """Join position, direction and weight of the rays."""
    try:
        return np.column_stack(columns)
    except ValueError as e:
        raise InputFileError(f"{path}: position, direction and weight must be of one length: {e}") from None


def load_npy(path: Path) -> np.ndarray:
    """Read the numbers of an .npy file; runs in a child process."""
    return np.asarray(np.load(path, allow_pickle=False), np.float64)
