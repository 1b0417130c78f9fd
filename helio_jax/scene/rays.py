"""Read the rays of a beam from a file: start and direction of every atom.

Lab axes, relative to the pinhole's centre; z points up, away from the sample, so directions point down. Files are
untrusted, see files.py.
"""

import io
from pathlib import Path

import numpy as np

from helio_jax.errors import InputFileError
from helio_jax.scene.files import read_arrays, read_bytes, read_table

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
    data = read_bytes(path, MAX_RAYS_MB)
    is_text, what = kind == ".csv", "a table of numbers separated by commas"
    rows = read_table(path, data, what) if is_text else _read_numpy(path, data, kind)
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


def _read_numpy(path: Path, data: bytes, kind: str) -> np.ndarray:
    """Read the rows of a NumPy file."""
    try:
        if kind == ".npz":
            return np.column_stack(read_arrays(path, data, MAX_RAYS_MB, ("position", "direction"), ("weight",)))
        return np.asarray(np.load(io.BytesIO(data), allow_pickle=False), np.float64)
    except InputFileError:
        raise
    except Exception as e:  # numpy raises many kinds on corrupt files
        raise InputFileError(f"{path}: is not a readable {kind} file ({type(e).__name__}: {e})") from None
