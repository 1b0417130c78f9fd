"""Height maps on a regular grid of the sample frame. No computation."""

from dataclasses import dataclass

import numpy as np

from helio_jax.arrays import check_axis, set_float_arrays
from helio_jax.errors import InputFileError


@dataclass(frozen=True)
class HeightMap:
    """Heights on a regular x, y grid (checked when made).

    Attributes:
        height: height above the substrate [y, x], um; NaN where unknown.
        x, y: grid positions in the sample frame [um], increasing, equally spaced.
        height_std: standard deviation of each height [y, x], um; None: unknown.
    """

    height: np.ndarray
    x: np.ndarray
    y: np.ndarray
    height_std: np.ndarray | None = None

    def __post_init__(self) -> None:
        set_float_arrays(self, {"x": (None,), "y": (None,)}, InputFileError)
        check_axis("x", self.x, InputFileError)
        check_axis("y", self.y, InputFileError)
        shape = (self.y.size, self.x.size)
        set_float_arrays(self, {"height": shape, "height_std": shape}, InputFileError)
