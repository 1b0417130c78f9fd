"""Read scene files (TOML) and the files that a scene names: height maps, positions, scattering tables. Meshes: mesh.py.

Files are untrusted: sizes are limited before anything is read, arrays are parsed in a limited child process, no pickle,
every failure names the file.
"""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.child import call_in_child, check_unpacked
from helio_jax.errors import HelioError, InputFileError, SceneError
from helio_jax.heightmap import HeightMap
from helio_jax.texts import parse_toml

MAX_HEIGHT_MAP_MB = 512.0
"""Largest height map file, and largest content of an .npz after decompression."""
MAX_POSITIONS_MB = 64.0
"""Largest list of beam positions."""
MAX_SCATTERING_TABLE_MB = 64.0
"""Largest table of scattered intensities."""


def read_bytes(path: Path, max_mb: float, error: type[HelioError] = InputFileError) -> bytes:
    """Read a whole file of at most `max_mb` megabytes.

    Raises:
        error: as `check_file`.
    """
    check_file(path, max_mb, error)
    try:
        return path.read_bytes()
    except OSError as e:
        raise error(f"{path}: cannot be read: {e}") from None


def check_file(path: Path, max_mb: float, error: type[HelioError] = InputFileError) -> None:
    """Check that a file can be read and has at most `max_mb` megabytes.

    Raises:
        error: missing, not a regular file, unreadable, empty or too large.
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
        with path.open("rb"):
            pass
    except (OSError, ValueError) as e:
        raise error(f"{path}: cannot be read: {e}") from None


def read_toml(path: Path, max_mb: float) -> dict[str, Any]:
    """Read a TOML file of at most `max_mb` megabytes.

    Raises:
        SceneError: as `read_bytes`; not UTF-8, not TOML, nested too deeply, or a whole number of more than 64 bits.
    """
    raw = read_bytes(path, max_mb, SceneError)
    try:
        return parse_toml(raw.decode("utf-8-sig"))
    except UnicodeDecodeError as e:
        line = raw[: e.start].count(b"\n") + 1
        text = f"{path}: is not UTF-8 text (byte {raw[e.start]:#04x} in line {line}): save it as UTF-8"
        raise SceneError(text) from None
    except ValueError as e:
        raise SceneError(f"{path}: is not valid TOML: {e}") from None


def read_height_map(path: Path, unit: float, pixel_size: float | None) -> HeightMap:
    """Read a height map: .npz with arrays x [x], y [y], height [y, x]; .csv, .tsv, .txt with one grid row per line.

    Args:
        path: of the file.
        unit: length of the file's unit [um].
        pixel_size: grid pitch of a text file [um]; not used for .npz, which has its own axes.

    Raises:
        InputFileError: as `check_file`; unknown kind; missing arrays; wrong shapes; not numbers.
    """
    kind = path.suffix.lower()
    if kind not in (".npz", ".csv", ".tsv", ".txt"):
        raise InputFileError(f"{path}: a height map must be .npz, .csv, .tsv or .txt, got {kind or 'no suffix'!r}")
    if kind == ".npz":
        x, y, height = (unit * a for a in read_arrays(path, MAX_HEIGHT_MAP_MB, ("x", "y", "height")))
    else:
        if pixel_size is None:
            raise InputFileError(f"{path}: a text grid needs sample.pixel_size_um, its pitch in um")
        height = unit * _read_grid(path, MAX_HEIGHT_MAP_MB)
        y, x = (pixel_size * (np.arange(n) - 0.5 * (n - 1)) for n in height.shape)
    try:
        return HeightMap(height, x, y)
    except InputFileError as e:
        raise InputFileError(f"{path}: {e}") from None


def read_arrays(path: Path, max_mb: float, needed: tuple[str, ...], optional: tuple[str, ...] = ()) -> list[np.ndarray]:
    """Read named arrays of an .npz in float64: all needed ones, then the optional ones that exist.

    Raises:
        InputFileError: as `check_file`; no readable .npz, larger than `max_mb` megabytes or than `check_unpacked`
            allows once unpacked, pickled, or an array is missing.
    """
    check_file(path, max_mb)
    return call_in_child("helio_jax.scene.files:load_arrays", path, max_mb, needed, optional)


def load_arrays(path: Path, max_mb: float, needed: list[str], optional: list[str]) -> list[np.ndarray]:
    """Read arrays for `read_arrays`; runs in a child process."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > max_mb * 1e6:
            raise InputFileError(f"{path}: unpacks to {size / 1e6:.0f} MB, the limit is {max_mb:g} MB")
        with np.load(path, allow_pickle=False) as arrays:
            if missing := [name for name in needed if name not in arrays.files]:
                raise InputFileError(
                    f"{path}: lacks {', '.join(missing)}; it has {', '.join(arrays.files) or 'nothing'}: save it with "
                    f"numpy.savez(file, {', '.join(f'{name}=...' for name in needed)})"
                )
            found: list[np.ndarray] = []
            for name in [*needed, *(name for name in optional if name in arrays.files)]:
                one = arrays[name]
                check_unpacked(path, 8 * (one.size + sum(a.size for a in found)), "its arrays, 8 bytes a number,")
                found.append(np.asarray(one, np.float64))
            return found
    except (InputFileError, MemoryError):
        raise
    except Exception as e:  # zipfile, zlib and numpy raise many kinds on corrupt files
        raise InputFileError(f"{path}: is not a readable .npz file ({type(e).__name__}: {e})") from None


def read_table(path: Path, max_mb: float, what: str, *, separator: str | None = ",", titles: str = "") -> np.ndarray:
    """Read the numbers of a text file, UTF-8 [line, column]; # begins a comment.

    Args:
        path: of the file.
        max_mb: largest file [MB].
        what: expected content, for messages.
        separator: between the numbers of a line; None: white space.
        titles: a first line that equals this text, spaces ignored, is skipped.

    Raises:
        InputFileError: as `check_file`; not UTF-8, not numbers, or lines of different lengths.
    """
    check_file(path, max_mb)
    return call_in_child("helio_jax.scene.files:load_table", path, what, separator, titles)


def load_table(path: Path, what: str, separator: str | None, titles: str) -> np.ndarray:
    """Parse the numbers for `read_table`; runs in a child process."""
    try:
        lines = path.read_bytes().decode("utf-8-sig").splitlines()
        has_titles = bool(titles and lines) and lines[0].replace(" ", "") == titles
        return np.loadtxt(lines[has_titles:], delimiter=separator, ndmin=2)
    except (UnicodeDecodeError, ValueError) as e:
        raise InputFileError(f"{path}: is not {what} ({e}): put a # before a line of titles") from None


def _read_grid(path: Path, max_mb: float) -> np.ndarray:
    """Read a text grid [y, x]; separators are commas (.csv) or white space."""
    grid = read_table(path, max_mb, "a grid of numbers", separator="," if path.suffix.lower() == ".csv" else None)
    if min(grid.shape) < 2:
        raise InputFileError(f"{path}: a grid needs at least 2 x 2 values, got {grid.shape}")
    return grid


def read_positions(path: Path) -> np.ndarray:
    """Read beam positions [n, 2], um: x and y on each line, separated by a comma; # begins a comment.

    The first line may name the columns: "x_um,y_um".

    Raises:
        InputFileError: as `check_file`; not two numbers on each line; none at all; not finite.
    """
    if path.suffix.lower() != ".csv":
        raise InputFileError(f"{path}: a list of positions must be .csv, got {path.suffix or 'no suffix'!r}")
    what = "a list of positions, x and y in um on each line"
    points = read_table(path, MAX_POSITIONS_MB, what, titles="x_um,y_um")
    if points.ndim != 2 or not len(points) or points.shape[1] != 2 or not np.all(np.isfinite(points)):
        raise InputFileError(
            f"{path}: must hold two finite numbers (x, y in um) on each line, got {len(points)} lines of "
            f"{points.shape[-1] if points.size else 0} numbers"
        )
    return points


def read_scattering_table(path: Path) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """Read intensities per steradian on a full grid: columns ([incidence,] theta, phi, intensity), angles in degrees.

    Returns:
        Axes incidence [i], theta [t] and phi [p] (0 to pi, the other half is the mirror image; or 0 to 2 pi), rad, and
        the intensity [i, t, p].

    Raises:
        InputFileError: as `check_file`; not numbers; no full grid; angles or intensities out of range.
    """
    rows = _read_grid(path, MAX_SCATTERING_TABLE_MB)
    if rows.shape[1] not in (3, 4) or not np.all(np.isfinite(rows)):
        raise InputFileError(
            f"{path}: a scattering table needs 3 or 4 columns of finite numbers ([incidence,] theta, phi, intensity), "
            f"got {rows.shape[1]} columns"
        )
    rows = rows if rows.shape[1] == 4 else np.column_stack([np.zeros(len(rows)), rows])
    axes, place = zip(*(np.unique(column, return_inverse=True) for column in rows[:, :3].T), strict=True)
    shape = tuple(axis.size for axis in axes)
    if np.unique(np.ravel_multi_index(place, shape)).size != len(rows) or len(rows) != np.prod(shape):
        raise InputFileError(
            f"{path}: {len(rows)} rows do not fill a grid of {shape[0]} x {shape[1]} x {shape[2]} angles (incidence, "
            "theta, phi) once each: give every combination on one line"
        )
    intensity = np.zeros(shape)
    intensity[place] = rows[:, 3]
    incidence, theta, phi = axes
    if incidence[0] < 0 or incidence[-1] > 90 or theta[0] < 0 or theta[-1] > 90 or theta.size < 2:
        raise InputFileError(f"{path}: incidence and theta must lie within 0 to 90 deg, with two theta at least")
    if phi.size < 2 or phi[0] != 0 or not (phi[-1] == 180 or 180 < phi[-1] <= 360):
        raise InputFileError(
            f"{path}: phi must run from 0 to 180 deg (mirrored) or from 0 to at most 360 deg, got "
            f"{phi[0]:g} to {phi[-1]:g} deg"
        )
    if phi[-1] not in (180.0, 360.0):
        phi, intensity = np.append(phi, 360.0), np.concatenate([intensity, intensity[..., :1]], -1)
    if intensity.min() < 0 or np.any(intensity[:, :, 1:].sum((1, 2)) <= 0):
        raise InputFileError(f"{path}: intensities must be >= 0, and > 0 somewhere for every incidence")
    return (np.radians(incidence), np.radians(theta), np.radians(phi)), intensity
