"""Records of steps: bands, steps, patches, and all of them."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from helio_jax.arrays import as_json, border_mask

_UNEXPLAINED = 0.05
"""Fraction of a patch's pixels in masks that no step explains, from which on its level is not relied on."""


@dataclass(frozen=True)
class BandRow:
    """Band of one detector at one edge.

    Attributes:
        step: number of the step.
        detector: name of the detector.
        kind: "dark": mask band; "lit": image of the wall.
        length_um, length_std_um: along the detector's direction (a mask band) or along the edge's normal (a wall).
        height_um, height_std_um: of the step; NaN where the band says nothing.
        is_lower_bound: something else, or the border, ends the band: length and height are those of its dark part.
        p_wall: probability that the signal falls abruptly at the edge; NaN for a wall's image.
        runs_deg: direction in which the band runs from the edge, counter-clockwise from +x.
        note: why a band is not used, or "".
    """

    step: int
    detector: str
    kind: str
    length_um: float
    length_std_um: float
    height_um: float
    height_std_um: float
    is_lower_bound: bool
    p_wall: float
    runs_deg: float
    note: str

    @property
    def is_clear_mask(self) -> bool:
        """Whether it is a mask band that nothing disturbs."""
        return self.kind == "dark" and self.note == ""


@dataclass(frozen=True)
class Step:
    """An edge from which the surface falls, straight or an arc of a round outline.

    Attributes:
        number: from 1.
        start, end: beam positions (x, y) of the upper edge's image [um], of an arc's those of the line that is its
            mean; the lower side lies to the right of start -> end.
        direction_deg: of the edge, -90 to 90; falls_deg: of its fall, -180 to 180; counter-clockwise from +x.
        height_um, height_std_um: combined over the detectors; NaN where no band determines it.
        n_bands: bands that are combined.
        chi2: of their agreement, with n_bands - 1 degrees of freedom.
        is_lower_bound: only lower bounds are known.
        p_wall: probability of a wall, rather than a gradual fall.
        above, below: numbers of the patches.
        note: "curved", "lower bound", "bands disagree", or "".
    """

    number: int
    start: tuple[float, float]
    end: tuple[float, float]
    direction_deg: float
    falls_deg: float
    height_um: float
    height_std_um: float
    n_bands: int
    chi2: float
    is_lower_bound: bool
    p_wall: float
    above: int
    below: int
    note: str

    @property
    def is_used(self) -> bool:
        """Whether the height counts for the levels of the patches."""
        return math.isfinite(self.height_um) and not self.is_lower_bound and self.note == ""


@dataclass(frozen=True)
class Patch:
    """A surface patch between steps.

    Attributes:
        number: 0: the largest patch, to which levels refer.
        pixels: its size.
        level_um, level_std_um: above patch 0; NaN where no step determines it.
        n_steps: steps that determine it.
        is_lower_bound: only lower bounds of steps are known.
        unexplained: fraction of its pixels that are masked from a detector though no step masks them: there are
            further steps in it.
    """

    number: int
    pixels: int
    level_um: float
    level_std_um: float
    n_steps: int
    is_lower_bound: bool
    unexplained: float

    @property
    def is_determined(self) -> bool:
        """Whether the level may be relied on."""
        return math.isfinite(self.level_um) and not self.is_lower_bound and self.unexplained < _UNEXPLAINED


def border_shares(patch: np.ndarray) -> np.ndarray:
    """Compute the share of every patch in the outermost ring of pixels [patch], from the numbers of patches [y, x]."""
    ring = patch[border_mask((patch.shape[0], patch.shape[1]), 1.0 / max(patch.shape))]
    return np.bincount(ring, minlength=int(patch.max()) + 1) / ring.size


@dataclass(frozen=True)
class Steps:
    """All steps of a stack.

    Attributes:
        steps, bands, patches: the lists.
        patch: number of every pixel's patch [y, x].
        is_masked: masked pixels [detector, y, x]; p_masked: their probabilities.
        chi2, dof: of the agreement of all steps with the patches' levels.
    """

    steps: tuple[Step, ...]
    bands: tuple[BandRow, ...]
    patches: tuple[Patch, ...]
    patch: np.ndarray
    is_masked: np.ndarray
    p_masked: np.ndarray
    chi2: float
    dof: int

    @property
    def ground(self) -> Patch:
        """The patch that has most of the image's border: the substrate, if any is. Its level may be undetermined."""
        shares = border_shares(self.patch)
        return max(self.patches, key=lambda p: shares[p.number])

    @property
    def level(self) -> np.ndarray:
        """Level of every pixel's patch [y, x], um."""
        return np.array([p.level_um for p in self.patches])[self.patch]

    @property
    def level_std(self) -> np.ndarray:
        """Standard deviation of every pixel's level [y, x], um; infinite where it is not determined."""
        std = np.array([p.level_std_um for p in self.patches])
        return np.where(np.isfinite(std), std, np.inf)[self.patch]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-compatible record."""
        return {
            "steps": [as_json(vars(s)) for s in self.steps],
            "bands": [as_json(vars(b)) for b in self.bands],
            "patches": [as_json(vars(p)) for p in self.patches],
            "chi2": self.chi2,
            "dof": self.dof,
            "masked_share": as_json(self.is_masked.mean((1, 2))),
        }
