"""What a file leaves open: the orientation of its arrays and the detector of each image; and which of these are one.

A candidate is one of the eight orientations with one order of the images. Where an orientation maps the instrument
onto itself, candidates come in groups of which no fit can prefer one: the sample turned or mirrored as a whole. Knows
no fit.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Any

from helio_jax.alignment.orientation import Turn, instrument_symmetries
from helio_jax.instrument import Instrument

MAX_PERMUTED = 4
"""Up to so many detectors all orders of the images are tried; of more only those that keep neighbours neighbours."""


@dataclass(frozen=True)
class Candidate:
    """An orientation and an order of the images.

    Attributes:
        turn: how all images are mirrored and turned.
        order: for each detector the image, from 0, that becomes its own.
    """

    turn: Turn
    order: tuple[int, ...]

    @property
    def change(self) -> tuple[bool, int, int]:
        """How much it changes, to choose between ties: mirror, images dealt anew, turn."""
        return self.turn.mirror, sum(i != k for i, k in enumerate(self.order)), self.turn.turn_deg

    def followed_by(self, turn: Turn, onto: tuple[int, ...]) -> "Candidate":
        """Return it turned again as a whole, the image of detector k going to detector `onto[k]`."""
        order = [0] * len(self.order)
        for k, target in enumerate(onto):
            order[target] = self.order[k]
        return Candidate(turn.after(self.turn), tuple(order))

    @property
    def reversed(self) -> "Candidate":
        """The candidate with all slopes reversed: turned by 180 deg, every image kept."""
        return Candidate(Turn(180).after(self.turn), self.order)

    def names(self, instrument: Instrument) -> tuple[str, ...]:
        """Return the detector of each image of the file."""
        return tuple(instrument.detector_names[self.order.index(i)] for i in range(len(self.order)))

    def as_dict(self, instrument: Instrument) -> dict[str, Any]:
        """Return a JSON-compatible record, by the names of the settings that give it by hand."""
        names = list(self.names(instrument))
        return {"turn_deg": self.turn.turn_deg, "mirror": self.turn.mirror, "detectors": names}


def orders_tried(instrument: Instrument) -> tuple[list[tuple[int, ...]], bool]:
    """Return the orders of the images to try, and whether these are all there are."""
    n = len(instrument.detector)
    if n <= MAX_PERMUTED:
        return list(itertools.permutations(range(n))), True
    return _ring_orders(instrument), False


def _ring_orders(instrument: Instrument) -> list[tuple[int, ...]]:
    """Return the orders that shift or reverse the detectors around the ring, by azimuth."""
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
    """Return candidates in groups of those that the instrument's symmetries turn into one another, order kept."""
    symmetries = instrument_symmetries(instrument)
    left, groups = dict.fromkeys(candidates), []
    while left:
        first = next(iter(left))
        same = {first.followed_by(*s) for s in symmetries}
        ties = tuple(c for c in left if c in same)
        groups.append(ties)
        left = dict.fromkeys(c for c in left if c not in same)
    return groups
