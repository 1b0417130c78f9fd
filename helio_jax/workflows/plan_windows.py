"""Rotation centre of a stage from two or more measured scans, and the windows that keep a region in view."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.errors import InputFileError, SceneError
from helio_jax.formats.acquisition import Acquisition, read_acquisitions
from helio_jax.formats.safe import atomic_path
from helio_jax.planning.coverage import scans_per_pixel
from helio_jax.planning.stage import RotationCenter, find_rotation_center


@dataclass(frozen=True)
class Windows:
    """Stage windows of rotated scans.

    Attributes:
        rotations_deg: of the sample, counter-clockwise in the frame of the imported scans [deg].
        centers: stage position of each window's centre in that frame [view, 2], um.
        size: extent of every window in x and y [um].
        axes: coordinate of the stage that x and y are, with sign, e.g. ("+hori", "-vert").
        rotation_center: of the stage.
        seen_by_all: share of the first window's pixels that all windows see.
    """

    rotations_deg: tuple[float, ...]
    centers: np.ndarray
    size: tuple[float, float]
    axes: tuple[str, str]
    rotation_center: RotationCenter
    seen_by_all: float

    def rows(self) -> list[dict[str, float]]:
        """List the windows: rotation [deg]; centre, lowest and highest position in the stage's coordinates [um]."""
        out = []
        for rotation, center in zip(self.rotations_deg, self.centers, strict=True):
            row = {"rotation_deg": rotation}
            for axis, middle, extent in zip(self.axes, center, self.size, strict=True):
                value = float(middle) * (-1.0 if axis[0] == "-" else 1.0)
                ends = {"center": value, "low": value - 0.5 * extent, "high": value + 0.5 * extent}
                row |= {f"{axis[1:]}_{name}_um": round(v, 3) + 0.0 for name, v in ends.items()}
            out.append(row)
        return out

    def as_dict(self) -> dict[str, Any]:
        """Make a JSON-compatible record; numbers that are not known are null."""
        center = {k: v if v == v else None for k, v in asdict(self.rotation_center).items()}
        about = {"axes": list(self.axes), "size_um": list(self.size), "seen_by_all": self.seen_by_all}
        return {"windows": self.rows(), "rotation_center": center, **about}

    def write(self, path: str | Path) -> None:
        """Write the windows as CSV, one per line."""
        text, rows = io.StringIO(), self.rows()
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        with atomic_path(path) as part:
            part.write_text(text.getvalue(), encoding="utf-8")


def plan_windows(
    scans: Sequence[str | Path],
    picks: Mapping[str, Mapping[str, tuple[float, float]]],
    rotations_deg: Sequence[float],
    center_um: tuple[float, float] = (0.0, 0.0),
) -> Windows:
    """Find the rotation centre of a stage, and the windows that keep a region centred at other rotations.

    Valid at normal incidence, for A-SHeM scans, whose files state the rotation and the stage window.

    Args:
        scans: measured files of two or more rotations (.mat, or .h5 of `helio import`); the first one has the region.
        picks: points of the sample, {scan: {point: (x, y) [um]}}, beam positions of each scan (`helio pick`); one
            point in two scans suffices, two or more also give the error and test the sign of the rotations.
        rotations_deg: wanted rotations of the sample, as the files state them [deg].
        center_um: centre of the region, a beam position of the first scan [um].

    Raises:
        InputFileError: less than two scans, scans without picks or stage window, no common point.
        SceneError: no rotation is wanted.
        GuardError: the points fit the opposite rotations better.

    Example:
        >>> picks = {"a.mat": {"1": (10.0, 5.0)}, "b.mat": {"1": (3.0, 9.0)}}
        >>> hx.plan_windows(["a.mat", "b.mat"], picks, [0.0, 90.0, 180.0]).rows()
    """
    found = [a for path in scans for a in read_acquisitions(path)]
    if len(found) < 2:
        raise InputFileError(f"the rotation centre needs two scans or more of different rotation, got {len(found)}")
    if not rotations_deg:
        raise SceneError("plan windows for one rotation or more, got none: give --rotations")
    if missing := [a.name for a in found if not picks.get(a.name)]:
        raise InputFileError(
            f"scan {missing[0]!r} has no points among the views {', '.join(picks) or 'none'}: pick them (helio pick)"
        )
    center = find_rotation_center(_stage_positions(found, picks), np.array([a.rotation for a in found]))
    first, angles = found[0], np.radians(rotations_deg)
    position = np.asarray(first.center) + np.asarray(center_um)
    windows = center.windows(position, first.rotation, angles)
    x, y = (np.arange(-0.5 * s, 0.5 * s + 1e-6 * s, p) for s, p in zip(first.size, first.pixel, strict=True))
    seen = scans_per_pixel(x, y, angles - angles[0], np.zeros((len(angles), 2))) == len(angles)
    rotations = tuple(float(a) for a in rotations_deg)
    return Windows(rotations, windows, first.size, first.axes, center, float(seen.mean()))


def _stage_positions(
    scans: Sequence[Acquisition], picks: Mapping[str, Mapping[str, tuple[float, float]]]
) -> np.ndarray:
    """Return the stage position of every point in every scan [view, point, 2], um; NaN where it was not picked."""
    names = list(dict.fromkeys(point for scan in scans for point in picks[scan.name]))
    unknown = (float("nan"), float("nan"))
    return np.array([[np.add(s.center, picks[s.name].get(name, unknown)) for name in names] for s in scans])
