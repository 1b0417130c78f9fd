"""The result of a reconstruction: a height for every pixel of the raster, in the beam frame. A noun.

Height [y, x] belongs to beam position (raster_x[j], raster_y[i]); the surface point itself lies at
(x[y, x], y[y, x]), which oblique incidence shifts by -h tan t. Overhangs and shadows are jumps. No computation.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from helio_jax.arrays import as_float_array, check_axis, pitch
from helio_jax.errors import InputFileError
from helio_jax.instrument import Instrument

REASONS = (
    "valid",
    "too few images",
    "masked in too many detectors",
    "depth jump",
    "outside the data",
    "floating",
)
"""What the integers of `Reconstruction.reason` mean."""


@dataclass(frozen=True)
class Reconstruction:
    """Heights of the surface seen by the beam (frozen, checked when made).

    Attributes:
        height: above the reference plane [y, x], um.
        raster_x, raster_y: beam positions [um].
        instrument: of the scan that was reconstructed.
        method: "linear", "nearfield" or "refine".
        normals: unit surface normals, up [y, x, 3].
        albedo: relative reflectivity, flat = 1 [y, x].
        height_std: standard deviation of each height [um], or None where the method gives none.
        height_samples: joint posterior deviations of all heights [sample, y, x], um, or None; see `spread`.
        is_valid: True where the height rests on enough data [y, x].
        reason: index into `REASONS` [y, x].
        residuals: (data - model) / standard deviation [detector, y, x].
        gain, offset: per detector, fitted or assumed: data = gain * model + offset.
        status: a sentence: how the method ended.
        provenance: JSON-compatible.
    """

    height: np.ndarray
    raster_x: np.ndarray
    raster_y: np.ndarray
    instrument: Instrument
    method: str
    normals: np.ndarray
    albedo: np.ndarray
    is_valid: np.ndarray
    reason: np.ndarray
    height_std: np.ndarray | None = None
    height_samples: np.ndarray | None = None
    residuals: np.ndarray | None = None
    gain: np.ndarray | None = None
    offset: np.ndarray | None = None
    status: str = ""
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        error = InputFileError
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731 (frozen record, once)
        for name in ("raster_x", "raster_y"):
            axis = as_float_array(name, getattr(self, name), (None,), error)
            check_axis(name, axis, error)
            put(name, axis)
        shape = (self.raster_y.size, self.raster_x.size)
        n_detectors = len(self.instrument.detector)
        shapes: dict[str, tuple[int | None, ...]] = {
            "height": shape,
            "albedo": shape,
            "height_std": shape,
            "height_samples": (None, *shape),
            "normals": (*shape, 3),
            "residuals": (n_detectors, *shape),
            "gain": (n_detectors,),
            "offset": (n_detectors,),
        }
        for name, wanted in shapes.items():
            if getattr(self, name) is not None:
                put(name, as_float_array(name, getattr(self, name), wanted, error))
        for name, kind in (("is_valid", bool), ("reason", np.uint8)):
            value = np.asarray(getattr(self, name))
            if value.shape != shape:
                raise error(f"{name} must have the shape {shape} of the raster, got {value.shape}")
            put(name, value.astype(kind))
        if self.reason.max(initial=0) >= len(REASONS):
            raise error(f"reason must be < {len(REASONS)}, got {self.reason.max()}")

    def spread(self, number: Callable[[np.ndarray], float]) -> tuple[float, float]:
        """Return a number derived from the heights and its standard deviation; the latter is NaN without samples.

        Args:
            number: from heights [y, x], um, e.g. the mean of one terrace minus that of another.
        """
        value = float(number(self.height))
        if self.height_samples is None:
            return value, float("nan")
        drawn = [float(number(self.height + deviation)) - value for deviation in self.height_samples]
        return value, float(np.sqrt(np.mean(np.square(drawn))))

    @property
    def x(self) -> np.ndarray:
        """Sample-frame x of every surface point [y, x], um."""
        tx, _ = self.instrument.beam_shift
        return self.raster_x[None, :] - self.height * tx

    @property
    def y(self) -> np.ndarray:
        """Sample-frame y of every surface point [y, x], um."""
        _, ty = self.instrument.beam_shift
        return self.raster_y[:, None] - self.height * ty

    @property
    def has_relief(self) -> np.ndarray:
        """True where heights mean something beside one another: valid, or floating together [y, x]."""
        return self.is_valid | (self.reason == REASONS.index("floating"))

    def beam_positions(self, pixels: np.ndarray) -> np.ndarray:
        """Return the beam positions (x, y) [n, 2], um, of places in pixels (column, row) [n, 2]."""
        first, step = zip(*((axis[0], pitch(axis)) for axis in (self.raster_x, self.raster_y)), strict=True)
        return np.array(first) + pixels * step

    def replace(self, **changes: Any) -> "Reconstruction":
        """Return a copy with some fields changed (and checked again)."""
        return replace(self, **changes)
