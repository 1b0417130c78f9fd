"""How a measured scan was acquired: times, stage window, rotation; from the metadata that a file carries.

Reads B-SHeM and A-SHeM scans (.mat) and the HDF5 files into which `helio import` wrote them. Stage positions are in the
frame of the imported stack (its axes and handedness, absolute), so that a beam position of the stack plus the centre of
the window is a stage position.
"""

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from helio_jax.errors import InputFileError
from helio_jax.formats.hdf5 import read_micrographs
from helio_jax.formats.matlab import describe_matlab
from helio_jax.formats.suffixes import HDF5_SUFFIXES
from helio_jax.formats.tables import describe_value, get_number, get_table


@dataclass(frozen=True)
class Acquisition:
    """One measured scan.

    Attributes:
        name: of the scan.
        n_lines, n_per_line: lines, pixels of a line.
        dwell: counting time of a pixel [s].
        pause: rest before each pixel [s].
        seconds: duration of the scan [s], or None: not stated.
        center: stage position (x, y) of the window's centre, in the frame of the imported stack [um].
        size: extent of the beam positions in x and y [um].
        pixel: distance between pixels in x and y [um].
        rotation: of the sample, counter-clockwise in that frame [rad].
        axes: which stage coordinate of the file is x and which is y, with sign, e.g. ("+hori", "-vert").
    """

    name: str
    n_lines: int
    n_per_line: int
    dwell: float
    pause: float
    seconds: float | None
    center: tuple[float, float]
    size: tuple[float, float]
    pixel: tuple[float, float]
    rotation: float
    axes: tuple[str, str]

    @property
    def n_pixels(self) -> int:
        """Pixels of the scan."""
        return self.n_lines * self.n_per_line


_AXES = {"B-SHeM": ("-vert", "-hori"), "A-SHeM": ("+hori", "-vert")}
_UNIT_UM = {"B-SHeM": 1e-6, "A-SHeM": 1e-3}
"""Of the stage positions in the file [um]."""


def read_acquisitions(path: str | os.PathLike) -> tuple[Acquisition, ...]:
    """Read how the scans of a file were acquired: one of a .mat file, or those of a stack or a set (.h5).

    Raises:
        InputFileError: missing, corrupt, not measured, or without times and stage window.
    """
    if Path(path).suffix.lower() not in HDF5_SUFFIXES:
        found = describe_matlab(path)
        return (_acquisition(f"{path}", Path(path).stem, found["kind"], found["metadata"]),)
    return tuple(
        _acquisition(
            f"{path}: {stack.name}",
            stack.name,
            str(dict(stack.provenance.get("source", {})).get("kind", "unknown")),
            dict(stack.provenance.get("metadata", {})),
        )
        for stack in read_micrographs(path).stacks
    )


def _acquisition(where: str, name: str, kind: str, metadata: dict[str, Any]) -> Acquisition:
    """Take times and window from the metadata of a scan."""
    if kind not in _AXES:
        raise InputFileError(
            f"{where}: times and stage positions are read from B-SHeM and A-SHeM scans, got a file of kind {kind!r}: "
            "give the measured file (.mat), or what helio import made of it"
        )
    scan = get_table(where, metadata, "meas_list")
    inputs = scan.get("inputs") or []
    given = {k: v for k, v in zip(inputs[::2], inputs[1::2], strict=False) if isinstance(k, str)}
    unit = _UNIT_UM[kind]
    ends, pixel = {}, {}
    for direction in ("hori", "vert"):
        ends[direction] = sorted(v * unit for v in _numbers(where, scan, f"{direction}_range", 2))
        pixel[direction] = get_number(where, scan, f"{direction}_res", low=0.0) * unit
    n = {d: round((high - low) / pixel[d]) + 1 for d, (low, high) in ends.items()}
    fast, slow = ("vert", "hori") if given.get("fast_axis") == "vertical" else ("hori", "vert")
    is_counting = kind == "B-SHeM"
    period = get_number(where, scan, "sampling_period", low=0.0) if "sampling_period" in scan else 15.0
    dwell = get_number(where, scan, "dwell_time" if is_counting else "N_dwell", low=0.0)
    rotation = 0.0 if is_counting else _numbers(where, scan, "sample_orientation", 3)[1]
    named = [axis[1:] for axis in _AXES[kind]]
    signs = [-1.0 if axis[0] == "-" else 1.0 for axis in _AXES[kind]]
    middle = [sign * 0.5 * sum(ends[d]) for sign, d in zip(signs, named, strict=True)]
    took = scan.get("scan_time")
    return Acquisition(
        name=name,
        n_lines=n[slow],
        n_per_line=n[fast],
        dwell=dwell * 1e-3 * (1.0 if is_counting else period),
        pause=get_number(where, given, "pause") if "pause" in given else 0.0,
        seconds=float(took) if isinstance(took, (int, float)) and took > 0 else None,
        center=(middle[0], middle[1]),
        size=(ends[named[0]][1] - ends[named[0]][0], ends[named[1]][1] - ends[named[1]][0]),
        pixel=(pixel[named[0]], pixel[named[1]]),
        rotation=math.radians(rotation * 1e-6),
        axes=_AXES[kind],
    )


def _numbers(where: str, scan: dict[str, Any], name: str, n: int) -> list[float]:
    """Return a list of n finite numbers."""
    values = scan.get(name)
    if not isinstance(values, list) or len(values) != n:
        raise InputFileError(f"{where}: meas_list.{name} must be {n} numbers, got {describe_value(values)}")
    return [get_number(where, {name: value}, name) for value in values]
