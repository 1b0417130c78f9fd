"""The result of a reconstruction: one height per pixel of the raster, in the beam frame.

Height [i, j] belongs to beam position (raster_x[j], raster_y[i]). The surface point lies at (x[i, j], y[i, j]), shifted
by -h tan t at oblique incidence. Overhangs and shadowed regions appear as depth jumps.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from helio_jax.arrays import check_axis, pitch, set_float_arrays
from helio_jax.drawable import OnRaster
from helio_jax.errors import InputFileError
from helio_jax.instrument import Instrument
from helio_jax.validity import CONTRADICTED, MAX_CONTRADICTED, NONE_VALID, REASONS, VALID_RULE, contradicted_share


def was_interrupted(status: str) -> bool:
    """Whether a height map with this status is the best so far of a method that was interrupted."""
    return any(part.startswith("interrupted") for part in status.split("; "))


def end_if_interrupted(status: str) -> None:
    """Raise KeyboardInterrupt where a method was interrupted: what follows would take its heights for finished ones."""
    if was_interrupted(status):
        raise KeyboardInterrupt


@dataclass(frozen=True, repr=False)
class Reconstruction(OnRaster):
    """Heights of the surface seen by the beam (frozen, checked when made).

    Attributes:
        height: above the substrate [y, x], um.
        raster_x, raster_y: beam positions [um].
        instrument: of the scan that was reconstructed.
        method: "linear", "nearfield" or "refine".
        border: "flat": heights count from the substrate at the image's border; "free": their common level is unknown.
        normals: unit surface normals, up [y, x, 3].
        albedo: relative reflectivity, substrate = 1 [y, x].
        height_std: standard deviation of each height [y, x], um, or None if the method gives none.
        height_samples: joint posterior deviations of all heights [sample, y, x], um, or None; see `spread`.
        is_valid: True where the height may be trusted, by `validity.VALID_RULE` [y, x]; a height that is not finite
            never is.
        reason: index into `validity.REASONS` [y, x].
        residuals: (data - model) / standard deviation [detector, y, x].
        chi_square: mean square deviation, in standard deviations, of the data of each pixel and its neighbours from the
            micrographs traced on this height map [y, x]; None: not tested. See `inverse.verdict`.
        gain, offset: fitted or assumed, data = gain * model + offset [detector].
        status: one sentence on how the method ended.
        warnings: what to know before the heights are trusted, most important first; that the data contradict the map as
            a whole, and that no height is valid, is added and removed by itself.
        provenance: history, on which no step depends (JSON-compatible).

    Example:
        >>> hx.reconstruct(stack, "nearfield").height_std
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
    chi_square: np.ndarray | None = None
    gain: np.ndarray | None = None
    offset: np.ndarray | None = None
    border: Literal["flat", "free"] = "flat"
    status: str = ""
    warnings: tuple[str, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        error = InputFileError
        set_float_arrays(self, {"raster_x": (None,), "raster_y": (None,)}, error)
        check_axis("raster_x", self.raster_x, error)
        check_axis("raster_y", self.raster_y, error)
        shape = (self.raster_y.size, self.raster_x.size)
        n_detectors = len(self.instrument.detector)
        shapes: dict[str, tuple[int | None, ...]] = {
            "height": shape,
            "albedo": shape,
            "chi_square": shape,
            "height_std": shape,
            "height_samples": (None, *shape),
            "normals": (*shape, 3),
            "residuals": (n_detectors, *shape),
            "gain": (n_detectors,),
            "offset": (n_detectors,),
        }
        set_float_arrays(self, shapes, error)
        for name, kind in (("is_valid", bool), ("reason", np.uint8)):
            value = np.asarray(getattr(self, name))
            if value.shape != shape:
                raise error(f"{name} must have the shape {shape} of the raster, got {value.shape}")
            object.__setattr__(self, name, value.astype(kind))
        object.__setattr__(self, "is_valid", self.is_valid & np.isfinite(self.height))
        if self.reason.max(initial=0) >= len(REASONS):
            raise error(f"reason must be < {len(REASONS)}, got {self.reason.max()}")
        own = {CONTRADICTED: self.is_contradicted, NONE_VALID: not self.is_valid.any()}
        others = [" ".join(text.split()) for text in self.warnings if text not in own]
        object.__setattr__(self, "warnings", (*(text for text, holds in own.items() if holds), *others))

    def _in_short(self) -> str:
        ny, nx = self.height.shape
        return f"by {self.method}: {ny} x {nx} (y, x), {self.valid_share:.1%} valid"

    def spread(self, number: Callable[[np.ndarray], float]) -> tuple[float, float]:
        """Compute a number derived from the heights, and its posterior standard deviation (NaN without samples).

        Args:
            number: function of the heights [y, x], um, for example the height difference of two terraces.
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
        """True where height differences are meaningful: valid, or floating with an unknown common level [y, x]."""
        return self.is_valid | (self.reason == REASONS.index("floating"))

    @property
    def is_contradicted(self) -> bool:
        """Whether the data contradict the height map as a whole: `MAX_CONTRADICTED`."""
        return contradicted_share(self.reason) > MAX_CONTRADICTED

    @property
    def valid_share(self) -> float:
        """Share of the pixels with a valid height."""
        return float(np.mean(self.is_valid))

    @property
    def trust(self) -> dict[str, Any]:
        """What is to be trusted, as a JSON-compatible record: share and rule of valid heights, causes, warnings."""
        shares = {reason: float(np.mean(self.reason == k)) for k, reason in enumerate(REASONS) if k}
        return {
            "valid_share": self.valid_share,
            "valid_rule": VALID_RULE,
            "not_valid": {reason: share for reason, share in shares.items() if share},
            "is_contradicted": self.is_contradicted,
            "warnings": list(self.warnings),
        }

    def beam_positions(self, pixels: np.ndarray) -> np.ndarray:
        """Convert pixel coordinates (column, row) [n, 2] to beam positions (x, y) [n, 2], um."""
        first, step = zip(*((axis[0], pitch(axis)) for axis in (self.raster_x, self.raster_y)), strict=True)
        return np.array(first) + pixels * step

    def replace(self, **changes: Any) -> "Reconstruction":
        """Return a validated copy with some fields changed."""
        return replace(self, **changes)
