"""Height maps on a regular grid of the sample frame. No computation."""

from dataclasses import dataclass

import numpy as np

from helio_jax.arrays import as_float_array, check_axis
from helio_jax.errors import InputFileError


@dataclass(frozen=True)
class HeightMap:
    """Heights on a regular x, y grid (checked when made).

    Attributes:
        height: height above the substrate [y, x], um; NaN where unknown.
        x, y: grid positions in the sample frame [um], increasing, equally spaced.
    """

    height: np.ndarray
    x: np.ndarray
    y: np.ndarray

    def __post_init__(self) -> None:
        for name in ("x", "y"):
            axis = as_float_array(name, getattr(self, name), (None,), InputFileError)
            check_axis(name, axis, InputFileError)
            object.__setattr__(self, name, axis)
        shape = (self.y.size, self.x.size)
        object.__setattr__(self, "height", as_float_array("height", self.height, shape, InputFileError))
