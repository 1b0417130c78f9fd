"""Height maps on a regular grid of the sample frame. No computation."""

from dataclasses import dataclass

import numpy as np

from helio_jax.arrays import check_axis, set_float_arrays
from helio_jax.drawable import Drawable
from helio_jax.errors import InputFileError


@dataclass(frozen=True, repr=False)
class HeightMap(Drawable):
    """Heights on a regular x, y grid (checked when made).

    Attributes:
        height: height above the substrate [y, x], um; NaN where unknown.
        x, y: grid positions in the sample frame [um], increasing, equally spaced.
    """

    height: np.ndarray
    x: np.ndarray
    y: np.ndarray

    def __post_init__(self) -> None:
        set_float_arrays(self, {"x": (None,), "y": (None,)}, InputFileError)
        check_axis("x", self.x, InputFileError)
        check_axis("y", self.y, InputFileError)
        set_float_arrays(self, {"height": (self.y.size, self.x.size)}, InputFileError)

    def _in_short(self) -> str:
        return f"{self.y.size} x {self.x.size} (y, x)"
