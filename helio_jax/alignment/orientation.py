"""The eight orientations of a raw array and the order of its images: candidates, their symmetries, turned stacks.

Files may not state the orientation of their arrays. There are eight: mirrored (x -> -x) or not, then turned
counter-clockwise by 0, 90, 180 or 270 degrees, all images together, about the beam position (0, 0); pictures are drawn
origin lower (arrays.py). A candidate is an orientation with an order of the images. Where an orientation maps the
instrument onto itself, several candidates are equivalent: the sample is turned or mirrored as a whole, and no fit can
prefer one. Does not know heights.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from helio_jax.detector import Aperture
from helio_jax.errors import InputFileError
from helio_jax.instrument import Instrument
from helio_jax.micrograph import OF_ONE_SCAN, MicrographStack

MAX_PERMUTED = 4
"""Up to so many detectors all orders of the images are tried; with more only shifts and reversals along the ring."""
_PER_DETECTOR = ("parallax", "counts", "variance", "is_observed", "effuse", "effuse_variance", "plate", "masked")
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
        """Matrix from old positions (x, y) to new ones [2, 2]."""
        c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[self.turn_deg // 90]
        return np.array([[c, -s], [s, c]]) @ np.diag([-1 if self.mirror else 1, 1])

    def after(self, first: "Turn") -> "Turn":
        """Compose: `first`, then this orientation."""
        wanted = self.matrix @ first.matrix
        return next(t for t in ALL_TURNS if np.array_equal(t.matrix, wanted))

    def image(self, array: np.ndarray) -> np.ndarray:
        """Mirror and turn images [..., y, x]."""
        array = array[..., ::-1] if self.mirror else array
        return np.ascontiguousarray(np.rot90(array, -(self.turn_deg // 90), axes=(-2, -1)))  # rows go up: other sense

    def axes(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the beam positions of the turned raster, increasing."""
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
    """Mirror and turn all images of a stack alike, and assign them to the detectors.

    The instrument and `sample_rotation` stay: this corrects how an array is read, not how the sample stood.

    Args:
        stack: a raster scan.
        turn: the orientation.
        order: for each detector of the instrument the number of its image, from 0.

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
    for name in ("by_order", "by_order_variance"):
        if getattr(stack, name) is not None:
            fields[name] = turn.image(getattr(stack, name)[:, pick])
    for name in ("shadowed", "parallax_height", "dwell_map"):
        if getattr(stack, name) is not None:
            fields[name] = turn.image(getattr(stack, name))
    x, y = turn.axes(stack.x, stack.y)
    is_odd = turn.turn_deg % 180 == 90
    fast = {"x": "y", "y": "x"}[stack.fast_axis] if is_odd else stack.fast_axis
    return stack.replace(x=x, y=y, fast_axis=fast, stage_position=None, **fields)


def bin_stack(stack: MicrographStack, max_pixels: int) -> MicrographStack:
    """Average a raster over squares of pixels so that no side is longer than `max_pixels`.

    Counts become means per pixel, variances those of the means; a square is observed where half of its pixels are. Rows
    and columns that fill no square are dropped, as are orders, masks and parts of the counts.
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
    dropped = dict.fromkeys((*OF_ONE_SCAN, "parallax", "parallax_height"))
    return stack.replace(
        counts=of(stack.counts),
        x=stack.x[: columns * n].reshape(columns, n).mean(1),
        y=stack.y[: rows * n].reshape(rows, n).mean(1),
        variance=None if stack.variance is None else of(stack.variance) / (known * n * n),
        is_observed=share >= 0.5,
        background=background,
        dwell_map=None if stack.dwell_map is None else mean(stack.dwell_map),
        **dropped,
    )


def instrument_symmetries(instrument: Instrument) -> tuple[tuple[Turn, tuple[int, ...]], ...]:
    """Find the orientations that map beam and apertures onto themselves.

    Each entry is an orientation and, for each detector, the number of the detector onto which it is mapped; the first
    entry is the identity. The images of a sample and of the turned sample are then equal but for their order, so no fit
    can distinguish them.
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
    """Compute centre and shape (matrix root of the ellipse) of a turned aperture, over the distance."""
    c, s = math.cos(aperture.rotation), math.sin(aperture.rotation)
    turn = matrix @ np.array([[c, -s], [s, c]])
    return np.concatenate([matrix @ aperture.center, (turn @ np.diag(aperture.semi_axes) @ turn.T).ravel()]) / distance


@dataclass(frozen=True)
class Candidate:
    """An orientation and an order of the images.

    Attributes:
        turn: orientation of all images.
        order: for each detector the number of its image, from 0.
    """

    turn: Turn
    order: tuple[int, ...]

    @property
    def change(self) -> tuple[bool, int, int]:
        """Amount of change, to choose between ties: mirror, number of images reassigned, turn."""
        return self.turn.mirror, sum(i != k for i, k in enumerate(self.order)), self.turn.turn_deg

    def followed_by(self, turn: Turn, onto: tuple[int, ...]) -> "Candidate":
        """Turn the candidate again as a whole; the image of detector k goes to detector `onto[k]`."""
        order = [0] * len(self.order)
        for k, target in enumerate(onto):
            order[target] = self.order[k]
        return Candidate(turn.after(self.turn), tuple(order))

    @property
    def reversed(self) -> "Candidate":
        """The candidate with all slopes reversed: turned by 180 deg, every image kept."""
        return Candidate(Turn(180).after(self.turn), self.order)

    def names(self, instrument: Instrument) -> tuple[str, ...]:
        """List the detector of each image of the file."""
        return tuple(instrument.detector_names[self.order.index(i)] for i in range(len(self.order)))

    def as_dict(self, instrument: Instrument) -> dict[str, Any]:
        """Make a JSON-compatible record, by the names of the settings that state it."""
        names = list(self.names(instrument))
        return {"turn_deg": self.turn.turn_deg, "mirror": self.turn.mirror, "detectors": names}


def orders_tried(instrument: Instrument) -> tuple[list[tuple[int, ...]], bool]:
    """List the orders of the images to try, and whether these are all."""
    n = len(instrument.detector)
    if n <= MAX_PERMUTED:
        return list(itertools.permutations(range(n))), True
    return _ring_orders(instrument), False


def _ring_orders(instrument: Instrument) -> list[tuple[int, ...]]:
    """List the orders that shift or reverse the detectors around the ring, by azimuth."""
    azimuths = [math.atan2(a.center[1], a.center[0]) for a in instrument.apertures()]
    ring = sorted(range(len(azimuths)), key=lambda k: azimuths[k])
    n, out = len(ring), []
    for step, start in itertools.product((1, -1), range(n)):
        order = [0] * n
        for place, k in enumerate(ring):
            order[k] = ring[(start + step * place) % n]
        out.append(tuple(order))
    return out


def group_ties(candidates: list[Candidate], instrument: Instrument) -> list[tuple[Candidate, ...]]:
    """Group the candidates that the symmetries of the instrument map onto one another, order kept."""
    symmetries = instrument_symmetries(instrument)
    left, groups = dict.fromkeys(candidates), []
    while left:
        first = next(iter(left))
        same = {first.followed_by(*s) for s in symmetries}
        ties = tuple(c for c in left if c in same)
        groups.append(ties)
        left = dict.fromkeys(c for c in left if c not in same)
    return groups
