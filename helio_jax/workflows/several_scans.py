"""One surface from several scans of a sample: other rotations or beams, one plate and distance.

The surface is a height for every x, y of the sample frame, seen straight down. Each scan's images are read where its
own beam meets the current surface, so that a point's place in oblique scans tells its height, too; what one beam
shadows another one sees. Heights and places are found by iteration. At normal incidence heights move no pixel.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy import ndimage

from helio_jax.alignment.correction import correct_motions
from helio_jax.alignment.resample import check_joinable, common_raster, resample
from helio_jax.alignment.rigid import Rigid
from helio_jax.arrays import fill_gaps, pitch
from helio_jax.errors import InputFileError
from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics
from helio_jax.inverse.linear import MIN_IMAGES, signal_of
from helio_jax.inverse.methods import reconstruct_stack
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.measure.sample_grid import resample_heights
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.reconstruction import Reconstruction

MAX_ITERATIONS = 30
"""Largest number of iterations between heights and places."""
SETTLED = 0.05
"""They end where places change by less than this, root mean square [pixels]."""
FIRST_SMOOTHING, LAST_SMOOTHING, FALL = 3.0, 0.5, 0.8
"""Fitted motions: smoothing of the images in the first iteration, the least one [pixels], its factor per iteration."""
UNSETTLED = 0.2
"""A larger change in the last iteration is warned of [pixels]."""
DAMPING = 0.6
"""Share of the way to the new heights: on steep flanks undamped iterations oscillate."""
Motions = Literal["stage", "fitted"]


@dataclass(frozen=True)
class JoinedScans:
    """Several scans on one raster of the sample frame.

    Attributes:
        scans: the scans, of one dose and with names of their own.
        stack: their images on the raster; the detectors of all scans one after the other.
        motions: of each scan, from the common frame.
        motion_std: standard deviation of a pixel's place by each motion [um]; 0 where the stage is taken at its word.
        change: of the places in the last iteration, root mean square [pixels].
        motion_change: of the places by the last correction of fitted motions [pixels]; 0 where they are not fitted.
    """

    scans: MicrographSet
    stack: MicrographStack
    motions: tuple[Rigid, ...]
    motion_std: tuple[float, ...]
    change: float = 0.0
    motion_change: float = 0.0

    @classmethod
    def at(
        cls, scans: MicrographSet, motions: tuple[Rigid, ...], std: tuple[float, ...], height: np.ndarray | None
    ) -> "JoinedScans":
        """Read the images of scans at heights of the common raster [y, x], um; None: heights move no pixel."""
        return cls(scans, resample(scans, motions, "reference", std, height), motions, std)

    def on(self, height: np.ndarray) -> "JoinedScans":
        """Read the images anew on other heights [y, x], um."""
        assert self.stack.parallax_height is not None  # of oblique beams
        change = _moved(self.scans, height - self.stack.parallax_height)
        joined = JoinedScans.at(self.scans, self.motions, self.motion_std, height)
        return replace(joined, change=change, motion_change=self.motion_change)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to know before heights of the stack are trusted."""
        changes = {"the scans' places on the surface": self.change, "the fitted motions": self.motion_change}
        return tuple(
            f"{what} have not converged: the last iteration moved places in the images by {change:.2f} pixels (limit "
            f"{UNSETTLED:g})"
            for what, change in changes.items()
            if change >= UNSETTLED
        )


def stage_motions(scans: MicrographSet) -> tuple[Rigid, ...]:
    """Return the motions that the stage states: the samples' rotations about the raster's origin."""
    return tuple(Rigid(s.sample_rotation, (0.0, 0.0)) for s in scans.stacks)


def join_scans(
    scans: MicrographSet,
    settings: ReconstructSettings | None = None,
    *,
    motions: Motions | tuple[Rigid, ...] = "stage",
    say: Callable[[str], None] = lambda text: None,
) -> JoinedScans:
    """Bring scans of one sample onto one raster of the sample frame, by heights of the photometric method.

    Args:
        scans: two or more, of one plate at one distance, three or more images in all; calibrated or simulated.
        settings: of the reconstruction: border, integrator.
        motions: rotations and shifts of the sample from scan to scan: "stage": as the files state them; "fitted": from
            there on, by the images (the first scan stays); or given.
        say: called with what was done.

    Raises:
        InputFileError: scans of different distances, or a list of positions.
    """
    _check(scans)
    scans = _comparable(scans)
    found = stage_motions(scans) if isinstance(motions, str) else motions
    exact = std = (0.0,) * len(found)
    if not scans.is_oblique and motions != "fitted":
        return JoinedScans.at(scans, found, std, None)
    quick = (settings or ReconstructSettings()).changed(method="nearfield", samples=0)
    height = merged_heights(scans, found, lambda scan: reconstruct_stack(scan, quick))
    joined, moved = JoinedScans.at(scans, found, std, height), 0.0
    for number in range(MAX_ITERATIONS):
        smoothing = LAST_SMOOTHING
        if motions == "fitted":
            smoothing = max(LAST_SMOOTHING, FIRST_SMOOTHING * FALL**number)
            # the motions' own uncertainty, in the data's variance, would hide the edges that determine them
            found, std, moved = _corrected_motions(JoinedScans.at(scans, found, exact, height), height, smoothing)
            joined = replace(JoinedScans.at(scans, found, std, height), motion_change=moved)
        height = height + DAMPING * (reconstruct_stack(joined.stack, quick).height - height)
        joined = joined.on(height)
        say(f"iteration {number + 1}: places on the surface changed by {max(joined.change, moved):.2f} pixels")
        if max(joined.change, moved) < SETTLED and smoothing == LAST_SMOOTHING:
            break
    return joined


def _moved(scans: MicrographSet, change: np.ndarray) -> float:
    """Compute by how much changed heights move places in the most oblique scan, root mean square [pixels]."""
    tan = max(float(np.hypot(*s.instrument.beam_shift)) for s in scans.stacks)
    return tan * float(np.sqrt(np.mean(change**2))) / pitch(scans.stacks[0].x)


def merged_heights(
    scans: MicrographSet, motions: tuple[Rigid, ...], height_of: Callable[[MicrographStack], Reconstruction]
) -> np.ndarray:
    """Merge what each scan of three or more images shows alone, on the common raster [y, x], um: the mean of all.

    Where none shows anything, the nearest heights; a flat without such scans.
    """
    x, y = common_raster(scans.stacks, motions, "reference")
    points, found = np.stack(np.meshgrid(x, y), -1), []
    for stack, motion in zip(scans.stacks, motions, strict=True):
        if stack.shape[0] < MIN_IMAGES:
            continue
        seen = resample_heights(height_of(stack), pitch(x), use_all=True)
        at = motion.apply(points)
        place = [(at[..., 1] - seen.y[0]) / pitch(seen.y), (at[..., 0] - seen.x[0]) / pitch(seen.x)]
        found.append(ndimage.map_coordinates(seen.height, place, order=1, cval=np.nan))
    if not found:
        return np.zeros(points.shape[:2])
    is_seen = np.isfinite(found)
    return fill_gaps(np.where(is_seen, found, 0.0).sum(0) / np.maximum(is_seen.sum(0), 1), np.any(is_seen, axis=0))


def _corrected_motions(
    joined: JoinedScans, height: np.ndarray, smoothing: float
) -> tuple[tuple[Rigid, ...], tuple[float, ...], float]:
    """Correct all motions but the first scan's by what all images agree on.

    Returns:
        The motions, the standard deviation of a pixel's place by each [um], and by how much the largest correction
        moves places [pixels].
    """
    stack, scans = joined.stack, joined.scans.stacks
    phi = form_factor(Optics.of(stack.instrument), height)
    scan = np.repeat(np.arange(len(scans)), [s.shape[0] for s in scans])
    stated = tuple(m.inverse().after(s) for m, s in zip(joined.motions, stage_motions(joined.scans), strict=True))
    found = correct_motions(*signal_of(stack), phi, stack.is_observed, scan, stack.x, stack.y, smoothing, stated)
    motions = tuple(m.after(c) for m, c in zip(joined.motions, found.motions, strict=True))
    return motions, found.std, max(found.moved) / pitch(stack.x)


def _comparable(scans: MicrographSet) -> MicrographSet:
    """Bring the counts of all scans to the first one's number of beam atoms, where it is known; give each a name.

    The names are those of the scans, without the name of the scene that views have in common.
    """
    dose, names = scans.stacks[0].n_rays, [s.name for s in scans.stacks]
    parts = [name.partition(", ") for name in names]
    if len({scene for scene, _, _ in parts}) == 1 and all(view for _, _, view in parts):
        names = [view for _, _, view in parts]
    if len(set(names)) < len(names):
        names = [f"{number} {name}" for number, name in enumerate(names, 1)]
    out = []
    for s, name in zip(scans.stacks, names, strict=True):
        changes: dict[str, Any] = {"name": name}
        if dose and s.n_rays and s.n_rays != dose:
            factor = dose / s.n_rays
            changes |= {"counts": factor * s.counts, "n_rays": dose}
            changes |= {"variance": None if s.variance is None else factor**2 * s.variance}
            changes |= {"background": None if s.background is None else factor * s.background}
        out.append(s.replace(**changes))
    return MicrographSet(tuple(out))


def _check(scans: MicrographSet) -> None:
    """Refuse scans that one surface below one plate cannot explain."""
    check_joinable(scans.stacks)
    first = scans.stacks[0]
    for stack in scans.stacks:
        if stack.positions is not None:
            raise InputFileError(f"{stack.name}: heights need rasters, this scan is a list of positions: leave it out")
        if min(stack.shape[1:]) < 2:
            size = " x ".join(map(str, stack.shape[1:]))
            raise InputFileError(f"heights need rasters of 2 x 2 or more pixels, scan {stack.name!r} has {size}")
        for name in ("sample_distance", "working_distance"):
            a, b = getattr(first.instrument, name), getattr(stack.instrument, name)
            if not np.isclose(a, b):
                raise InputFileError(
                    f"scans {first.name!r} and {stack.name!r} must have one {name.replace('_', ' ')}, got {a:g} and "
                    f"{b:g} um: reconstruct them one by one"
                )
