"""Objects of known shape as a user states them: "ball radius=1000", "wedge height=200 slope=30+-0.5".

A number is known exactly, or with "+-" to a standard deviation; what is not stated is free. The place of the object in
the image is always free.
"""

import math
import re
from dataclasses import dataclass
from typing import NamedTuple

from helio_jax.errors import SceneError
from helio_jax.spelling import did_you_mean

FREE_STD = 1.0
"""Prior standard deviation of a free length or angle, relative to where the fit starts."""
MAX_BALL_HEIGHT = 1.05
"""Largest height of a ball over its radius: what an aperture sees under an overhanging ball is not modelled."""
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_STATED = re.compile(rf"({_NUMBER})(?:\+-({_NUMBER}))?")


class Stated(NamedTuple):
    """A number with its standard deviation, 0: exact."""

    value: float
    std: float = 0.0


@dataclass(frozen=True)
class KnownObject:
    """Shape of an object on a flat substrate (checked when made).

    Attributes:
        kind: "ball", "step" (a vertical wall), "wedge" (a plane facet up to a terrace) or "flat".
        radius: of a ball [um].
        height: of its top above the substrate, or of the terrace [um]; None: free.
        slope: angle of a wedge to the substrate [deg].
        facing: azimuth of the lower side of a step or wedge, counter-clockwise from +x [deg]; where the fit starts.
    """

    kind: str
    radius: Stated | None = None
    height: Stated | None = None
    slope: Stated | None = None
    facing: float = 0.0

    @classmethod
    def parse(cls, text: str) -> "KnownObject":
        """Read what a user states.

        Raises:
            SceneError: an unknown shape, key or number, or a missing or impossible one.
        """
        kind, *pairs = text.split() or [""]
        if kind not in _KEYS:
            remedy = did_you_mean(kind, _KEYS) or f"known are {', '.join(_KEYS)}"
            raise SceneError(f"known shape {text!r}: there is no shape {kind!r}: {remedy}")
        found: dict[str, Stated] = {}
        for pair in pairs:
            key, _, number = pair.partition("=")
            if key not in _KEYS[kind]:
                raise SceneError(
                    f"known shape {text!r}: a {kind} has no {key!r}, "
                    + (f"it has {', '.join(_KEYS[kind])}" if _KEYS[kind] else "it has no numbers")
                )
            match = _STATED.fullmatch(number)
            if match is None or key in found:
                raise SceneError(
                    f"known shape {text!r}: give {key} once, as {key}=NUMBER or {key}=NUMBER+-STD (um, deg), or leave "
                    f"it out if it is unknown, got {pair!r}"
                )
            found[key] = Stated(float(match[1]), float(match[2] or 0.0))
        for key in _NEEDED[kind]:
            if key not in found:
                raise SceneError(f"known shape {text!r}: a {kind} needs {key}: add {key}=NUMBER")
        facing = found.pop("facing", Stated(0.0)).value
        return cls(kind, facing=facing, **found)

    def __post_init__(self) -> None:
        for name in ("radius", "height", "slope"):
            stated = getattr(self, name)
            high = 90.0 if name == "slope" else 1e6
            if stated is not None and not (0.0 < stated.value < high and 0.0 <= stated.std < 1e6):
                raise SceneError(
                    f"known shape {self.kind}: {name} must be > 0 and < {high:g}, its deviation >= 0, got "
                    f"{stated.value:g} +- {stated.std:g}: correct it"
                )
        if self.radius is not None and self.height is not None:
            most = MAX_BALL_HEIGHT * self.radius.value
            if self.height.value > most:
                raise SceneError(
                    f"known shape ball: height must be at most {MAX_BALL_HEIGHT:g} radii = {most:g} um, got "
                    f"{self.height.value:g}: what is seen under an overhanging ball is not modelled; use another object"
                )

    def starts(self) -> list["KnownObject"]:
        """List the shapes from which a fit starts: a free height at several shares of the radius."""
        if self.kind != "ball" or self.height is not None or self.radius is None:
            return [self]
        r = self.radius.value
        return [KnownObject("ball", self.radius, Stated(share * r, FREE_STD * r)) for share in (0.4, 0.65, 0.9)]

    def numbers(self) -> tuple[float, float, float]:
        """Return radius and height [um], and the facet's angle [rad]; 0 where the shape has none."""
        slope = math.radians(self.slope.value) if self.slope else 0.5 * math.pi
        values = (self.radius.value if self.radius else 0.0, self.height.value if self.height else 0.0)
        return (*values, slope)

    def stds(self) -> tuple[float, float, float]:
        """Return the prior standard deviations of `numbers`, 0: exact."""
        r, h, s = (0.0 if stated is None else stated.std for stated in (self.radius, self.height, self.slope))
        return r, h, math.radians(s)


_KEYS: dict[str, tuple[str, ...]] = {
    "ball": ("radius", "height"),
    "step": ("height", "facing"),
    "wedge": ("height", "slope", "facing"),
    "flat": (),
}
_NEEDED: dict[str, tuple[str, ...]] = {
    "ball": ("radius",),
    "step": ("height",),
    "wedge": ("height", "slope"),
    "flat": (),
}
