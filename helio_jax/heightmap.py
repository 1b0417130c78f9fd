"""Height maps on a regular grid of the sample frame. No computation."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from helio_jax.arrays import check_axis, set_float_arrays
from helio_jax.drawable import OnRaster
from helio_jax.errors import InputFileError


@dataclass(frozen=True, repr=False)
class HeightMap(OnRaster):
    """Heights on a regular x, y grid (checked when made).

    Attributes:
        height: height above the substrate [y, x], um; NaN where unknown.
        x, y: grid positions in the sample frame [um], increasing, equally spaced.
        height_std: standard deviation of each height [y, x], um; None: unknown.
        status: one sentence on how the method that made the heights ended.
        provenance: history, on which no step depends (JSON-compatible).

    Example:
        >>> hx.HeightMap(np.zeros((5, 7)), x=np.arange(7.0), y=np.arange(5.0))
    """

    height: np.ndarray
    x: np.ndarray
    y: np.ndarray
    height_std: np.ndarray | None = None
    status: str = ""
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        set_float_arrays(self, {"x": (None,), "y": (None,)}, InputFileError)
        check_axis("x", self.x, InputFileError)
        check_axis("y", self.y, InputFileError)
        shape = (self.y.size, self.x.size)
        set_float_arrays(self, {"height": shape, "height_std": shape}, InputFileError)

    def _in_short(self) -> str:
        return f"{self.y.size} x {self.x.size} (y, x)"
