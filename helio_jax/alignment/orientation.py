"""Micrographs turned, mirrored, binned, and their images given to other detectors: what a raw array may need.

A file need not say which way its arrays lie. There are eight ways: mirrored (x -> -x) or not, then turned
counter-clockwise by 0, 90, 180 or 270 degrees, all images together, about the beam position (0, 0); pictures are drawn
origin lower (arrays.py). Heights and geometry are not known here.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from helio_jax.detector import Aperture
from helio_jax.errors import InputFileError
from helio_jax.instrument import Instrument
from helio_jax.micrograph import MicrographStack

_PER_DETECTOR = ("counts", "variance", "is_observed", "effuse", "plate", "masked")
"""Fields [detector, y, x] of a stack."""
_SAME = 1e-3
"""Two apertures are the same where they differ by less than this share of the working distance."""


@dataclass(frozen=True, order=True)
class Turn:
    """One of the eight orientations.

    Attributes:
        turn_deg: counter-clockwise turn, after the mirror: 0, 90, 180 or 270.
        mirror: whether x is reversed before the turn.
    """

    turn_deg: int = 0
    mirror: bool = False

    @property
    def matrix(self) -> np.ndarray:
        """What maps old positions (x, y) to new ones [2, 2]."""
        c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[self.turn_deg // 90]
        return np.array([[c, -s], [s, c]]) @ np.diag([-1 if self.mirror else 1, 1])

    def after(self, first: "Turn") -> "Turn":
        """Return the orientation that `first` and then this one amount to."""
        wanted = self.matrix @ first.matrix
        return next(t for t in ALL_TURNS if np.array_equal(t.matrix, wanted))

    def image(self, array: np.ndarray) -> np.ndarray:
        """Return images [..., y, x] mirrored and turned."""
        array = array[..., ::-1] if self.mirror else array
        return np.ascontiguousarray(np.rot90(array, -(self.turn_deg // 90), axes=(-2, -1)))  # rows go up: other sense

    def axes(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the beam positions of the turned raster, increasing."""
        out = []
        for row in self.matrix:
            axis, sign = (x, row[0]) if row[0] else (y, row[1])
            out.append(axis if sign > 0 else -axis[::-1])
        return out[0], out[1]

    def __str__(self) -> str:
        return f"{'mirrored, ' if self.mirror else ''}turned by {self.turn_deg} deg"


ALL_TURNS = tuple(Turn(turn, mirror) for mirror in (False, True) for turn in (0, 90, 180, 270))
"""The eight orientations, the one that changes nothing first."""


def turn_stack(stack: MicrographStack, turn: Turn, order: tuple[int, ...]) -> MicrographStack:
    """Return a stack with all images mirrored and turned alike and dealt to the detectors anew.

    The instrument stays. `sample_rotation` stays, too: this corrects how an array is read, not how the sample stood.

    Args:
        stack: a raster scan.
        turn: the orientation.
        order: for each detector of the instrument the image, counted from 0, that becomes its own.

    Raises:
        InputFileError: a list of positions, which has no array to turn.
    """
    if stack.positions is not None:
        raise InputFileError(
            f"{stack.name}: only a raster can be turned, this scan is a list of {len(stack.positions)} positions"
        )
    pick = list(order)
    fields: dict[str, Any] = {
        name: turn.image(getattr(stack, name)[pick]) for name in _PER_DETECTOR if getattr(stack, name) is not None
    }
    if stack.background is not None:
        fields["background"] = (
            stack.background[pick] if stack.background.ndim == 1 else turn.image(stack.background[pick])
        )
    if stack.by_order is not None:
        fields["by_order"] = turn.image(stack.by_order[:, pick])
    if stack.shadowed is not None:
        fields["shadowed"] = turn.image(stack.shadowed)
    x, y = turn.axes(stack.x, stack.y)
    is_odd = turn.turn_deg % 180 == 90
    fast = {"x": "y", "y": "x"}[stack.fast_axis] if is_odd else stack.fast_axis
    return stack.replace(x=x, y=y, fast_axis=fast, **fields)


def bin_stack(stack: MicrographStack, max_pixels: int) -> MicrographStack:
    """Return a raster averaged over squares of pixels so that no side is longer than `max_pixels`.

    Counts become means per pixel, variances those of the means; a square counts as observed where half of it is. Rows
    and columns that fill no square are left out. Orders, masks and parts of the counts are not kept.
    """
    n = math.ceil(max(stack.shape[1:]) / max_pixels)
    n = max(1, min(n, *(side // 3 for side in stack.shape[1:])))
    rows, columns = (side // n for side in stack.shape[1:])

    def mean(images: np.ndarray) -> np.ndarray:
        cut = images[..., : rows * n, : columns * n]
        return cut.reshape(*cut.shape[:-2], rows, n, columns, n).mean((-3, -1))

    share = mean(stack.is_observed.astype(float))
    known = np.maximum(share, 1e-12)
    of = lambda values: mean(np.where(stack.is_observed, values, 0.0)) / known  # noqa: E731
    background = stack.background
    if background is not None and background.ndim == 3:
        background = of(background)
    return MicrographStack(
        counts=of(stack.counts),
        x=stack.x[: columns * n].reshape(columns, n).mean(1),
        y=stack.y[: rows * n].reshape(rows, n).mean(1),
        instrument=stack.instrument,
        variance=None if stack.variance is None else of(stack.variance) / (known * n * n),
        is_observed=share >= 0.5,
        background=background,
        n_rays=stack.n_rays,
        fast_axis=stack.fast_axis,
        noise=stack.noise,
        unit=stack.unit,
        name=stack.name,
        provenance=stack.provenance,
    )


def instrument_symmetries(instrument: Instrument) -> tuple[tuple[Turn, tuple[int, ...]], ...]:
    """Return which orientations map beam and apertures onto themselves, and the detectors onto which ones.

    Each is an orientation and, for each detector, the number of the one that it falls upon; the first changes nothing.
    Pictures of a sample and of the turned sample are then one set of images in two orders: no fit can tell them apart.
    """
    shift, apertures = np.array(instrument.beam_shift), instrument.apertures()
    features = np.array([_features(a, np.eye(2), instrument.working_distance) for a in apertures])
    found = []
    for turn in ALL_TURNS:
        if np.abs(turn.matrix @ shift - shift).max() > _SAME:
            continue
        moved = np.array([_features(a, turn.matrix, instrument.working_distance) for a in apertures])
        apart = np.abs(moved[:, None] - features[None]).max(-1)
        onto = apart.argmin(1)
        if apart.min(1).max() < _SAME and np.unique(onto).size == onto.size:
            found.append((turn, tuple(int(k) for k in onto)))
    return tuple(found)


def _features(aperture: Aperture, matrix: np.ndarray, distance: float) -> np.ndarray:
    """Return the turned centre and the shape (matrix root of the ellipse) of an aperture, over the distance."""
    c, s = math.cos(aperture.rotation), math.sin(aperture.rotation)
    turn = matrix @ np.array([[c, -s], [s, c]])
    return np.concatenate([matrix @ aperture.center, (turn @ np.diag(aperture.semi_axes) @ turn.T).ravel()]) / distance
