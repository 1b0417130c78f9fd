"""Import micrographs from MATLAB files of the reference simulator, B-SHeM and A-SHeM. The only import of pymatreader.

The file is parsed in a limited child process, because SciPy's reader crashes on corrupt files. Its variables identify
the layout: `im.single` and `im.multiple` (reference simulator), `meas_list.image` as a list of channels (B-SHeM) or as
one array (A-SHeM). Images are converted to the frame of arrays.py. Data that the file lacks, such as the apertures,
come from the instrument. All scalar metadata go to `provenance["metadata"]`. No calibration.
"""

import hashlib
import math
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.arguments import checked
from helio_jax.arrays import as_json
from helio_jax.child import MIB, call_in_child, check_size, check_unpacked
from helio_jax.errors import InputFileError
from helio_jax.formats.matlab_reference import complete_instrument, read_counts
from helio_jax.formats.tables import get_array, get_number, get_table
from helio_jax.instrument import Instrument
from helio_jax.micrograph import MicrographStack

MAX_FILE_BYTES = 256 * MIB
_IMAGES = ("image", "single", "multiple")
_SUMMARISED = ("labtemp", "beam_pressure", "return_state")
_SMALL = 64
_COMPRESSED = 15
"""Type of a compressed variable."""
_EXAMPLE_INSTRUMENT = {
    "reference simulator": "bshem_wd4",
    "B-SHeM": "bshem_wd3",
    "A-SHeM": "ashem_normal",
}


@checked
def import_micrographs(path: str | os.PathLike, instrument: Instrument | None = None) -> MicrographStack:
    """Import the micrographs of one MATLAB file (level 5 format, at most 256 MiB).

    Args:
        path: file of the reference simulator, a B-SHeM or an A-SHeM scan.
        instrument: beam, plate and apertures. For the reference simulator only the aperture rotations, which its
            file lacks, are taken from here; contradictions are errors.

    Returns:
        The stack, detectors in the instrument's order; `provenance` holds the file, its SHA-256, the kind, the
        orientation of the raw array, the source of the variance, and the file's metadata.

    Raises:
        InputFileError: missing, corrupt, of another kind, no instrument given, or the instrument contradicts the file.

    Example:
        >>> hx.import_micrographs("scan.mat", hx.load_instrument("bshem_wd4"))
    """
    tree = _read_tree(path)
    digest = hashlib.sha256(Path(path).read_bytes()).hexdigest()
    kind = _find_kind(str(path), tree)
    if instrument is None:
        raise InputFileError(
            f"{path}: a {kind} file does not state the shape and rotation of its apertures: give the instrument, "
            f"for example --instrument {_EXAMPLE_INSTRUMENT[kind]}"
        )
    build = {"reference simulator": _reference_stack, "B-SHeM": _bshem_stack, "A-SHeM": _ashem_stack}[kind]
    fields, notes = build(str(path), tree, instrument)
    metadata = {k: _to_json(v) for k, v in tree.items()}
    provenance = {"source": {"file": Path(path).name, "sha256": digest, "kind": kind}, **notes, "metadata": metadata}
    try:
        return MicrographStack(**{"instrument": instrument, "name": Path(path).stem, **fields}, provenance=provenance)
    except InputFileError as e:
        raise InputFileError(f"{path}: {e}") from None


def describe_matlab(path: str | os.PathLike) -> dict[str, Any]:
    """Summarise the micrographs of a MATLAB file without an instrument; the result is JSON-compatible.

    Returns:
        kind; images: shape, min, mean and max by name, in the raw orientation; numbers: pixel and dwell time in words;
        metadata.

    Raises:
        InputFileError: missing, corrupt, or of another kind.
    """
    tree = _read_tree(path)
    kind = _find_kind(str(path), tree)
    scan, found = tree["im" if kind == "reference simulator" else "meas_list"], {}
    for key in _IMAGES:
        value = scan.get(key)
        several = isinstance(value, list)
        for i, image in enumerate(value if several else [value]):
            if isinstance(image, np.ndarray) and image.ndim == 2 and image.size:
                name = f"channel {i + 1}" if key == "image" and several else f"{key} {i + 1}" if several else key
                found[name] = {"shape": list(image.shape)} | {
                    word: float(getattr(image, word)()) for word in ("min", "mean", "max")
                }
    unit = {"B-SHeM": 1e-6, "A-SHeM": 1e-3, "reference simulator": 1e3}[kind]
    steps = ("raster_movement_x", "raster_movement_y") if kind == "reference simulator" else ("hori_res", "vert_res")
    pixel = [scan.get(name) for name in steps]
    numbers = {}
    if all(isinstance(p, (int, float)) for p in pixel):
        numbers["pixel"] = f"{float(pixel[0]) * unit:g} x {float(pixel[1]) * unit:g} um (columns x rows)"
    if isinstance(took := scan.get("scan_time"), (int, float)):
        numbers["scan time"] = f"{took:.0f} s"
    return {"kind": kind, "images": found, "numbers": numbers, "metadata": {k: _to_json(v) for k, v in tree.items()}}


def _read_tree(path: str | os.PathLike) -> dict[str, Any]:
    """Check a file's size and header and parse it in a child process."""
    check_size(path, MAX_FILE_BYTES)
    _check_header(Path(path))
    return call_in_child("helio_jax.formats.matlab:load_tree", path)


def _check_header(path: Path) -> None:
    """Check that a file has the header of a level 5 MATLAB file."""
    with path.open("rb") as file:
        head = file.read(19)
    if head.startswith(b"MATLAB 7.3"):
        raise InputFileError(f"{path} is a MATLAB 7.3 (HDF5) file: save it again with save(..., '-v7')")
    if head != b"MATLAB 5.0 MAT-file":
        raise InputFileError(f"{path} is not a MATLAB file (level 5): its header starts with {head!r}")


def load_tree(path: Path) -> dict[str, Any]:
    """Parse a level 5 MATLAB file and drop large arrays other than images; runs in a child process."""
    _check_packed(path)
    from pymatreader import read_mat  # loaded in the child process only

    tree = read_mat(str(path))
    found = {k: _reduce(k, v) for k, v in tree.items() if not k.startswith("__")}
    check_unpacked(path, 8.0 * _n_numbers(found), "its images, 8 bytes a number,")
    return found


def _check_packed(path: Path) -> None:
    """Refuse a file whose compressed variables declare more than `check_unpacked` allows, before they are unpacked.

    Source: MATLAB MAT-File Format, level 5: a header of 128 bytes, then variables; the tag of each is its type and its
        number of bytes; a compressed one (type 15) holds a whole variable with its own tag.
    """
    n_bytes = 0
    with path.open("rb") as file:
        file.seek(126)
        order = "<" if file.read(2) == b"IM" else ">"
        while len(tag := file.read(8)) == 8:
            kind, size = struct.unpack(f"{order}2I", tag)
            start = file.tell()
            if kind == _COMPRESSED:
                inner = zlib.decompressobj().decompress(file.read(min(size, 512)), 8)
                n_bytes += struct.unpack(f"{order}2I", inner)[1] if len(inner) == 8 else 0
            file.seek(start + size)
    check_unpacked(path, n_bytes, "its variables")


def _n_numbers(value: Any) -> int:
    """Count the numbers in a tree."""
    if isinstance(value, dict):
        value = list(value.values())
    return sum(map(_n_numbers, value)) if isinstance(value, list) else int(np.size(value))


def _reduce(name: str, value: Any) -> Any:
    """Keep images and small values; replace series by their statistics and other large arrays by None."""
    if isinstance(value, dict):
        kept = {k: _reduce(k, v) for k, v in value.items() if isinstance(k, str) and not k.startswith("_")}
        return {k: v for k, v in kept.items() if v is not None}
    if isinstance(value, list):
        return [_reduce(name, v) for v in value] if len(value) <= _SMALL else None
    if isinstance(value, (np.ndarray, np.generic)):
        if value.dtype.kind not in "fiubUS":
            return None
        is_number = value.dtype.kind in "fiub"
        if np.size(value) <= _SMALL or (name in _IMAGES and is_number):
            return value
        if name not in _SUMMARISED or not is_number or not np.isfinite(value).any():
            return None
        good = np.asarray(value)[np.isfinite(value)]
        return {"mean": float(good.mean()), "min": float(good.min()), "max": float(good.max())}
    return value if isinstance(value, (bool, int, float, str)) else None


def _to_json(value: Any) -> Any:
    """Convert metadata to JSON values: images omitted, non-finite numbers None."""
    if isinstance(value, dict):
        return {k: _to_json(v) for k, v in value.items() if k not in _IMAGES}
    if isinstance(value, np.ndarray) and value.size > _SMALL:
        return {"shape": list(value.shape)}
    if isinstance(value, list):
        return [_to_json(v) for v in value]
    return as_json(value)


def _find_kind(path: str, tree: dict[str, Any]) -> str:
    """Identify the layout."""
    im, scan = tree.get("im"), tree.get("meas_list")
    if isinstance(im, dict) and "single" in im and "multiple" in im:
        return "reference simulator"
    if isinstance(scan, dict) and isinstance(scan.get("image"), list):
        return "B-SHeM"
    if isinstance(scan, dict) and isinstance(scan.get("image"), np.ndarray):
        return "A-SHeM"
    found = ", ".join(list(tree)[:10]) or "none"
    raise InputFileError(
        f"{path} holds no known micrographs: neither im.single and im.multiple (reference simulator) nor "
        f"meas_list.image (B-SHeM, A-SHeM); its variables: {found}: read them yourself into a MicrographStack "
        "(docs/howto_mat.md)"
    )


def _reference_stack(path: str, tree: dict[str, Any], instrument: Instrument) -> tuple[dict[str, Any], dict]:
    """Read the reference simulator's counts: columns reversed, x pitch divided by cos t."""
    full, order = complete_instrument(path, tree, instrument)
    by_order = read_counts(path, tree, order)
    im = get_table(path, tree, "im")
    step_x = get_number(path, im, "raster_movement_x", low=0.0) * 1000 / math.cos(math.radians(full.beam.incidence_deg))
    step_y = get_number(path, im, "raster_movement_y", low=0.0) * 1000
    counts = by_order.sum(0)
    center = get_array(path, im.get("helio_center_um", np.zeros(2)), "im.helio_center_um", 1)  # helio's own export
    if center.shape != (2,):
        raise InputFileError(f"{path}: im.helio_center_um must be x and y, got {center.size} numbers")
    fields = {
        "counts": counts,
        "by_order": by_order,
        "variance": np.maximum(_mean_of_neighbours(counts), 1.0),
        "x": _centred(counts.shape[2], step_x) + center[0],
        "y": _centred(counts.shape[1], step_y) + center[1],
        "n_rays": get_number(path, get_table(path, tree, "param"), "rays_per_pixel", low=0.0),
        "noise": "poisson" if np.array_equal(counts, np.round(counts)) else "expected",  # helio's export may be either
        "instrument": full,
    }
    notes = {
        "orientation": "columns reversed, rows kept, x pitch divided by cos(incidence)",
        "variance_from": "Poisson: mean count of the 8 neighbours, at least 1",
    }
    return fields, notes


def _connected(path: str, channels: Any) -> str:
    """Name the channels that hold data."""
    images = [get_array(path, image, f"meas_list.image{{{i}}}", 2) for i, image in enumerate(channels, start=1)]
    found = [str(i) for i, image in enumerate(images, start=1) if np.any(image)]
    return f"data are in channel{'s' * (len(found) != 1)} {', '.join(found)}" if found else "no channel holds data"


def _bshem_stack(path: str, tree: dict[str, Any], instrument: Instrument) -> tuple[dict[str, Any], dict]:
    """Read a B-SHeM scan: per channel raw[::-1, ::-1].T, so that the beam travels towards +x."""
    scan = get_table(path, tree, "meas_list")
    channels = scan["image"]
    images = []
    for detector in instrument.detector:
        where = f"detector {detector.name!r}"
        if detector.channel is None or detector.channel > len(channels):
            raise InputFileError(
                f"{path}: {where} must name its channel, 1 to {len(channels)}, got {detector.channel}: "
                "set `channel` in the instrument file"
            )
        image = get_array(path, channels[detector.channel - 1], f"meas_list.image{{{detector.channel}}}", 2)
        if not np.any(image):
            raise InputFileError(
                f"{path}: channel {detector.channel} of {where} holds only zeros: it is not connected; "
                f"{_connected(path, channels)}: set `channel` in the instrument file"
            )
        images.append(image)
    used = [d.channel for d in instrument.detector]
    if len(set(used)) != len(used) or len({i.shape for i in images}) != 1:
        raise InputFileError(
            f"{path}: channels must differ and be of one size, got {used}, {[i.shape for i in images]}"
        )
    n_rows, n_columns = images[0].shape
    pm = 1e-6
    fast = _fast_direction(path, scan)
    variance = [_noise_variance(image, fast) for image in images]
    fields = {
        "counts": np.stack([image[::-1, ::-1].T for image in images]),
        "variance": _per_detector(variance, (n_columns, n_rows)),
        "x": _centred(n_rows, _raw_pitch(path, scan, "vert", n_rows) * pm),
        "y": _centred(n_columns, _raw_pitch(path, scan, "hori", n_columns) * pm),
        "dwell": get_number(path, scan, "dwell_time", low=0.0) * 1e-3,
        "stage_position": _stage_position(path, scan, pm),
        "fast_axis": "y" if fast == "horizontal" else "x",
        "noise": "measured",
    }
    return fields, _measured_notes("raw[::-1, ::-1].T, the scan runs from +x, +y to -x, -y", fast, variance)


def _stage_position(path: str, scan: dict[str, Any], unit: float) -> np.ndarray | None:
    """Return the stage's x, y and height [um] in the middle of a B-SHeM scan; None where the file does not state them.

    x = -vert and y = -hori, as the raster is read; `pos` holds the axes of the stage, the third is its height.
    """
    try:
        names = "vert_range", "hori_range", "pos"
        vert, hori, axes = (get_array(path, scan.get(name), f"meas_list.{name}", 1) for name in names)
    except InputFileError:
        return None
    place = unit * np.array([-vert.mean(), -hori.mean(), *axes[2:3]])
    return place if place.size == 3 and np.all(np.isfinite(place)) else None


def _ashem_stack(path: str, tree: dict[str, Any], instrument: Instrument) -> tuple[dict[str, Any], dict]:
    """Read an A-SHeM scan: one detector, rows reversed so that y goes up in the picture."""
    scan = get_table(path, tree, "meas_list")
    if len(instrument.detector) != 1:
        raise InputFileError(
            f"{path}: an A-SHeM scan has 1 detector, the instrument has {len(instrument.detector)}: "
            f"give the instrument of this microscope, for example {_EXAMPLE_INSTRUMENT['A-SHeM']}"
        )
    image = get_array(path, scan["image"], "meas_list.image", 2)
    n_rows, n_columns = image.shape
    nm = 1e-3
    fast = _fast_direction(path, scan)
    variance = [_noise_variance(image, fast)]
    orientation = get_array(path, scan.get("sample_orientation"), "meas_list.sample_orientation", 1)
    if orientation.size < 2:
        raise InputFileError(f"{path}: meas_list.sample_orientation must have 3 entries, got {orientation.size}")
    period = get_number(path, scan, "sampling_period", low=0.0) if "sampling_period" in scan else 15.0
    fields = {
        "counts": image[None, ::-1, :],
        "variance": _per_detector(variance, image.shape),
        "x": _centred(n_columns, _raw_pitch(path, scan, "hori", n_columns) * nm),
        "y": _centred(n_rows, _raw_pitch(path, scan, "vert", n_rows) * nm),
        "dwell": get_number(path, scan, "N_dwell", low=0.0) * period * 1e-3,
        "fast_axis": "x" if fast == "horizontal" else "y",
        "sample_rotation": math.radians(orientation[1] * 1e-6),
        "noise": "measured",
        "unit": "A",
    }
    return fields, _measured_notes("raw[::-1, :], the scan runs from -x, +y to +x, -y", fast, variance)


def _measured_notes(orientation: str, fast: str, variance: list[float]) -> dict[str, Any]:
    """Construct the provenance of a measured scan."""
    how = (
        "one value per detector: median of squared second differences along the fast axis, drift between lines excluded"
    )
    return {"orientation": orientation, "raw_fast_axis": fast, "variance_from": how, "noise_variance": variance}


def _fast_direction(path: str, scan: dict[str, Any]) -> str:
    """Return the raw array's fast axis, horizontal unless the scan's inputs state another one."""
    inputs = scan.get("inputs", [])
    for key, value in zip(inputs[::2], inputs[1::2], strict=False) if isinstance(inputs, list) else ():
        if isinstance(key, str) and key == "fast_axis":
            if value not in ("horizontal", "vertical"):
                raise InputFileError(
                    f"{path}: meas_list.inputs: fast_axis must be horizontal or vertical, got {value!r}"
                )
            return value
    return "horizontal"


def _raw_pitch(path: str, scan: dict[str, Any], direction: str, n: int) -> float:
    """Return the scan step in the file's unit; check that n - 1 steps span the range."""
    step = get_number(path, scan, f"{direction}_res", low=0.0)
    span = float(np.ptp(get_array(path, scan.get(f"{direction}_range"), f"meas_list.{direction}_range", 1)))
    if abs(span - (n - 1) * step) > 0.5 * step:
        raise InputFileError(
            f"{path}: the {direction} range must be {n} pixels of {step:g}, got a range of {span:g}: "
            "the scan is incomplete or the file is corrupt"
        )
    return step


def _centred(n: int, step: float) -> np.ndarray:
    """Compute n beam positions centred on zero [um]."""
    return (np.arange(n) - (n - 1) / 2) * step


def _per_detector(values: list[float], shape: tuple[int, ...]) -> np.ndarray:
    """Spread one value per detector over images of `shape`."""
    return np.broadcast_to(np.asarray(values)[:, None, None], (len(values), *shape)).copy()


def _mean_of_neighbours(counts: np.ndarray) -> np.ndarray:
    """Average the 8 neighbours of every pixel [detector, y, x]: its expected count, independent of its own noise.

    Weights 1 / count would favour low counts and bias every mean by one count (-0.25 % at 400 counts).
    Source: Mighell, ApJ 518 (1999) 380, sec. 2.
    """
    from scipy.ndimage import uniform_filter  # half a second that `helio info` does not need

    padded = np.pad(np.asarray(counts, float), ((0, 0), (1, 1), (1, 1)), mode="reflect")
    return (9.0 * np.asarray(uniform_filter(padded, 3, axes=(1, 2)))[:, 1:-1, 1:-1] - counts) / 8.0


def _noise_variance(image: np.ndarray, fast: str) -> float:
    """Estimate the noise variance of a pixel from second differences along the raw fast axis.

    Valid for white noise on an image that is smooth over 3 pixels in more than half of its area. Slow drift and
    offsets of lines are excluded.

    Source: own derivation: the second difference of white noise has 6 times its variance, and the median of its
        absolute value is 0.6745 standard deviations; tests/formats/test_matlab.py.
    """
    d = np.diff(image, 2, axis=1 if fast == "horizontal" else 0)
    d = d[np.isfinite(d)]
    return float((np.median(np.abs(d)) / 0.67449) ** 2 / 6) if d.size else math.nan
