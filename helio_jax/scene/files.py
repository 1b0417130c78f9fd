"""Reading of the files a sample may name: bounded bytes, and height maps from .npz and text grids.

Files are untrusted: sizes are limited before anything is read, no pickle, every failure names the file.
Meshes are read in sample.py, the door to trimesh.
"""

import io
import zipfile
from pathlib import Path

import numpy as np

from helio_jax.errors import HelioError, InputFileError
from helio_jax.heightmap import HeightMap

MAX_HEIGHT_MAP_MB = 512.0
"""Largest height map file, and largest content of an .npz after decompression."""


def read_bytes(path: Path, max_mb: float, error: type[HelioError] = InputFileError) -> bytes:
    """Read a whole file of at most `max_mb` megabytes.

    Raises:
        error: missing, not a regular file, unreadable, empty or too large; the message names the file.
    """
    try:
        if not path.exists():
            raise error(f"{path}: no such file (looked in {path.parent.resolve()})")
        if not path.is_file():
            raise error(f"{path}: is not a regular file")
        size = path.stat().st_size
        if size > max_mb * 1e6:
            raise error(f"{path}: the file has {size / 1e6:.1f} MB, the limit is {max_mb:g} MB")
        if size == 0:
            raise error(f"{path}: the file is empty")
        return path.read_bytes()
    except (OSError, ValueError) as e:
        raise error(f"{path}: cannot be read: {e}") from None


def read_height_map(path: Path, unit: float, pixel_size: float | None) -> HeightMap:
    """Read a height map: .npz with arrays x [x], y [y], height [y, x]; .csv, .tsv, .txt with one grid row per line.

    Args:
        path: of the file.
        unit: length of the file's unit [um].
        pixel_size: grid pitch of a text file [um]; not for .npz, which has its own axes.

    Raises:
        InputFileError: as `read_bytes`; unknown kind; missing arrays; wrong shapes; not numbers.
    """
    kind = path.suffix.lower()
    if kind not in (".npz", ".csv", ".tsv", ".txt"):
        raise InputFileError(f"{path}: a height map must be .npz, .csv, .tsv or .txt, got {kind or 'no suffix'!r}")
    data = read_bytes(path, MAX_HEIGHT_MAP_MB)
    if kind == ".npz":
        x, y, height = (unit * a for a in _read_npz(path, data))
    else:
        if pixel_size is None:
            raise InputFileError(f"{path}: a text grid needs sample.pixel_size_um, its pitch in um")
        height = unit * _read_grid(path, data, kind)
        y, x = (pixel_size * (np.arange(n) - 0.5 * (n - 1)) for n in height.shape)
    try:
        return HeightMap(height, x, y)
    except InputFileError as e:
        raise InputFileError(f"{path}: {e}") from None


def _read_npz(path: Path, data: bytes) -> list[np.ndarray]:
    """Return x, y and height as float64 arrays."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_HEIGHT_MAP_MB * 1e6:
            raise InputFileError(f"{path}: unpacks to {size / 1e6:.0f} MB, the limit is {MAX_HEIGHT_MAP_MB:g} MB")
        with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
            missing = [name for name in ("x", "y", "height") if name not in arrays.files]
            if missing:
                raise InputFileError(
                    f"{path}: lacks {', '.join(missing)}; it has {', '.join(arrays.files) or 'nothing'}: save it with "
                    "numpy.savez(file, x=..., y=..., height=...)"
                )
            return [np.asarray(arrays[name], np.float64) for name in ("x", "y", "height")]
    except InputFileError:
        raise
    except Exception as e:  # zipfile, zlib and numpy raise many kinds on corrupt files
        raise InputFileError(f"{path}: is not a readable .npz file ({type(e).__name__}: {e})") from None


def _read_grid(path: Path, data: bytes, kind: str) -> np.ndarray:
    """Return a text grid [y, x]; separators are commas (.csv) or white space."""
    try:
        grid = np.loadtxt(io.StringIO(data.decode("utf-8")), delimiter="," if kind == ".csv" else None, ndmin=2)
    except (UnicodeDecodeError, ValueError) as e:
        raise InputFileError(f"{path}: is not a grid of numbers: {e}") from None
    if min(grid.shape) < 2:
        raise InputFileError(f"{path}: a height map needs at least 2 x 2 values, got {grid.shape}")
    return grid
