"""Micrographs, simulated or measured: a noun that flows between the stages. Conventions: arrays.py.

`Calibration` and `ScanAlignment` state what was done to a stack, as far as later steps depend on it; `provenance` is
history, and no step depends on it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from helio_jax.arguments import expect
from helio_jax.arrays import as_float_array, as_json, check_axis, set_float_arrays
from helio_jax.drawable import Drawable, OnRaster
from helio_jax.errors import HelioError, InputFileError
from helio_jax.instrument import Instrument


@dataclass(frozen=True)
class Calibration:
    """Calibration of a measured stack to units of the beam, and its uncertainty (frozen, checked when made).

    Attributes:
        method: "border" (the signal of the flat border is known) or "constant_albedo" (aligned scans, one albedo).
        priors: settings of the fit (table [reconstruct.refine]) that state how uncertain the calibration is; a setting
            that the user gives wins. Numbers or lists of numbers.
        without_multiple: whether predicted multiple scattering was subtracted from the counts.
        warnings: what to know before heights are trusted.
    """

    method: Literal["border", "constant_albedo"]
    priors: Mapping[str, Any] = field(default_factory=dict)
    without_multiple: bool = False
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "warnings", tuple(self.warnings))
        if not all(isinstance(text, str) for text in self.warnings):
            raise InputFileError("calibration.warnings must be texts")
        if self.method not in ("border", "constant_albedo"):
            raise InputFileError(f"calibration.method must be border or constant_albedo, got {self.method!r}")
        if not isinstance(self.priors, Mapping) or not isinstance(self.without_multiple, bool):
            raise InputFileError("calibration.priors must be a table, calibration.without_multiple true or false")
        object.__setattr__(self, "priors", as_json(self.priors))
        for name, value in self.priors.items():
            as_float_array(f"calibration.priors.{name}", value, (None,) * np.ndim(value), InputFileError)


@dataclass(frozen=True)
class ScanAlignment:
    """States that the images of a stack are scans of a rotated sample, brought onto one raster (checked when made).

    Attributes:
        time_planes: for each image a, b, c [detector, 3]: a x + b y + c is the time at which its own scan recorded the
            point (x, y), -1 for the first line of the scan to 1 for the last one; None: not known.
    """

    time_planes: tuple[tuple[float, float, float], ...] | None = None

    def __post_init__(self) -> None:
        if self.time_planes is not None:
            planes = as_float_array("alignment.time_planes", self.time_planes, (None, 3), InputFileError)
            object.__setattr__(self, "time_planes", tuple(map(tuple, planes.tolist())))


SIMULATED_PARTS = "by_order", "by_order_variance", "effuse", "effuse_variance", "plate", "masked", "shadowed"
"""Fields that only the simulation of one scan on its own raster has."""
OF_ONE_SCAN = *SIMULATED_PARTS, "stage_position"
"""Fields that only one scan on its own raster has: what is made of scans has none of them."""


@dataclass(frozen=True, repr=False)
class MicrographStack(OnRaster):
    """Images of one scan, all detectors on one raster (frozen, checked when made).

    Attributes:
        counts: expected or measured counts per pixel [detector, y, x].
        x, y: beam positions [um], increasing, equally spaced.
        instrument: beam, plate and detectors, in the order of the detector axis.
        variance: of `counts`, counting noise included if the counts are noisy; of the Monte Carlo mean if the counts
            are expectations [detector, y, x]; None: unknown.
        is_observed: True where a count was recorded [detector, y, x]; None: everywhere.
        positions: beam positions (x, y) [x, 2], um, of a list of positions; then `x` is their index and `y` a single 0.
        background: counts per pixel that do not come from the sample [detector] or [detector, y, x]; None: unknown.
        by_order: counts by scattering order [order, detector, y, x]; the last entry holds its order and all above.
        effuse: counts from the effusive beam, not included in `counts` [detector, y, x].
        by_order_variance, effuse_variance: of the Monte Carlo mean of these two; the orders of a path are correlated.
        plate: part of `counts` that scattered on the plate at least once [detector, y, x].
        masked: fraction of the aperture's solid angle masked by the sample, local horizon included [detector, y, x].
        shadowed: 1 where the beam does not reach the topmost surface point above the raster position [y, x].
        parallax, parallax_height: of joined scans of oblique beams, whose images are read where their own beam meets
            the surface of these heights [y, x], um: change of the counts per um by which it is higher [detector, y, x].
        n_rays: beam atoms per pixel that the counts correspond to (simulated), or None.
        dwell: dwell time per pixel [s] (measured), or None.
        dwell_map: dwell time of every pixel [y, x], s, where it differs from pixel to pixel; counts, variance and
            background are then scaled to `dwell` seconds in every pixel. None: `dwell` everywhere.
        fast_axis: axis along which the scan moves fastest.
        sample_rotation: rotation of the sample about the plate normal [rad].
        stage_position: position of the stage (x, y, height) where the beam position is 0, 0 [3], um, so that stage
            position = stage_position + beam position in x and y; None: unknown.
        noise: "expected" (noise-free expectation), "poisson" (counts) or "measured".
        unit: unit of the counts ("counts", "A").
        name: short name of the scan.
        calibration: how measured counts were brought into units of the beam; None: they were not.
        alignment: set where the images are aligned scans of a rotated sample.
        materials: kind of scattering law by name of the material, of a simulated sample.
        provenance: history: scene, files, versions, seed, ray counters (JSON-compatible).

    Example:
        >>> hx.MicrographStack(counts, x, y, hx.load_instrument("bshem_wd4"), variance=counts)
    """

    counts: np.ndarray
    x: np.ndarray
    y: np.ndarray
    instrument: Instrument
    variance: np.ndarray | None = None
    is_observed: np.ndarray = None  # type: ignore[assignment]  # filled when made
    positions: np.ndarray | None = None
    background: np.ndarray | None = None
    by_order: np.ndarray | None = None
    by_order_variance: np.ndarray | None = None
    effuse: np.ndarray | None = None
    effuse_variance: np.ndarray | None = None
    plate: np.ndarray | None = None
    masked: np.ndarray | None = None
    shadowed: np.ndarray | None = None
    parallax: np.ndarray | None = None
    parallax_height: np.ndarray | None = None
    n_rays: float | None = None
    dwell: float | None = None
    dwell_map: np.ndarray | None = None
    fast_axis: Literal["x", "y"] = "x"
    sample_rotation: float = 0.0
    stage_position: np.ndarray | None = None
    noise: Literal["expected", "poisson", "measured"] = "expected"
    unit: str = "counts"
    name: str = "scan"
    calibration: Calibration | None = None
    alignment: ScanAlignment | None = None
    materials: Mapping[str, str] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        expect("MicrographStack: instrument", self.instrument, Instrument)
        error = InputFileError
        set_float_arrays(self, {"x": (None,), "y": (None,)}, error)
        check_axis("x", self.x, error)
        check_axis("y", self.y, error)
        shape = (len(self.instrument.detector), self.y.size, self.x.size)
        others = {
            "shadowed": shape[1:],
            "parallax_height": shape[1:],
            "dwell_map": shape[1:],
            "positions": (self.x.size, 2),
            "by_order": (None, *shape),
            "by_order_variance": (None, *shape),
            "stage_position": (3,),
        }
        is_background_image = self.background is not None and np.ndim(self.background) == 3
        others["background"] = shape if is_background_image else shape[:1]
        names = "counts", "variance", "effuse", "effuse_variance", "plate", "masked", "parallax"
        images = dict.fromkeys(names, shape)
        set_float_arrays(self, images | others, error)
        if self.positions is not None and (self.y.size != 1 or not np.all(np.isfinite(self.positions))):
            raise error(f"positions must be finite and belong to images of one row, got {self.y.size} rows")
        observed = np.isfinite(self.counts)
        if self.is_observed is not None:
            if np.shape(self.is_observed) != shape:
                raise error(f"is_observed must have the shape of counts {shape}, got {np.shape(self.is_observed)}")
            observed &= np.asarray(self.is_observed, bool)
        object.__setattr__(self, "is_observed", observed)
        if self.variance is not None and not np.all(self.variance[observed] >= 0):
            raise error(f"variance must be >= 0, got {self.variance[observed].min():g} at an observed pixel")
        if self.dwell_map is not None:
            self._check_dwell_map()
        if self.stage_position is not None and not np.all(np.isfinite(self.stage_position)):
            raise error(f"stage_position must be three finite numbers [um], got {self.stage_position.tolist()}")
        planes = None if self.alignment is None else self.alignment.time_planes
        if planes is not None and len(planes) != shape[0]:
            raise error(f"alignment.time_planes must hold one plane for each of {shape[0]} images, got {len(planes)}")

    def _check_dwell_map(self) -> None:
        """Refuse dwell times that counts cannot have been recorded in."""
        times = self.dwell_map
        assert times is not None  # of the caller
        if not self.dwell or not self.dwell > 0:
            raise InputFileError(
                f"dwell must be > 0 s where dwell_map is given, got {self.dwell}: set what counts are per"
            )
        if not np.all(np.isfinite(times) & (times >= 0.0)):
            raise InputFileError("dwell_map must hold finite times >= 0 s: set pixels that were not counted to 0")
        unrecorded = self.is_observed.any(0) & (times == 0.0)
        if unrecorded.any():
            raise InputFileError(
                f"dwell_map must be > 0 s where counts were recorded, got 0 at {int(unrecorded.sum())} such pixels: "
                "set is_observed to false there"
            )

    @property
    def dwell_times(self) -> np.ndarray | None:
        """Dwell time of every pixel [y, x], s; 0 where none of the images was recorded; None: unknown."""
        if self.dwell_map is not None:
            return self.dwell_map
        return None if self.dwell is None else np.where(self.is_observed.any(0), self.dwell, 0.0)

    def _in_short(self) -> str:
        n, ny, nx = self.shape
        return f"{self.name!r}: {n} x {ny} x {nx} (detector, y, x), {self.noise}, {self.unit}"

    @property
    def shape(self) -> tuple[int, int, int]:
        """(detectors, rows, columns)."""
        return self.counts.shape  # type: ignore[return-value]

    @property
    def std_error(self) -> np.ndarray | None:
        """Square root of `variance`."""
        return None if self.variance is None else np.sqrt(self.variance)

    @property
    def signal(self) -> np.ndarray:
        """Counts minus the background, if the background is known [detector, y, x]."""
        if self.background is None:
            return self.counts
        return self.counts - (self.background[:, None, None] if self.background.ndim == 1 else self.background)

    @property
    def is_without_multiple(self) -> bool:
        """Whether the calibration subtracted the predicted multiple scattering from the counts."""
        return self.calibration is not None and self.calibration.without_multiple

    @property
    def multiple(self) -> np.ndarray | None:
        """Counts of order 2 and above [detector, y, x], or None if the orders are unknown."""
        return None if self.by_order is None else self.by_order[1:].sum(0)

    @property
    def scan_time(self) -> np.ndarray | None:
        """Recording time of every pixel within its scan, -1 to 1 [detector, y, x]; known for aligned scans only."""
        if self.alignment is None or self.alignment.time_planes is None:
            return None
        x, y = np.meshgrid(self.x, self.y)
        return np.stack([a * x + b * y + c for a, b, c in self.alignment.time_planes])

    def count_fractions(self) -> dict[str, float]:
        """Compute the fractions of all counts (background excluded) from multiple scattering and from the plate.

        The effusive beam is not part of the counts; its counts are given relative to them.
        """
        total = float(np.sum(self.signal[self.is_observed]))
        parts = {"multiple scattering": self.multiple, "scattered on the plate": self.plate}
        parts["effusive beam, besides"] = self.effuse
        found = {name: float(part.sum()) for name, part in parts.items() if part is not None}
        return {name: part / total for name, part in found.items()} if total > 0 else {}

    @property
    def stacks(self) -> tuple["MicrographStack"]:
        """This stack, so that a stack can be used as a set of one."""
        return (self,)

    def only(self, error: type[HelioError] = InputFileError) -> "MicrographStack":
        """Return this stack, so that a stack can be used as a set of one."""
        return self

    def scaled(self, factor: np.ndarray) -> "MicrographStack":
        """Multiply counts, variance, background and parallax by a factor of every detector [detector, 1, 1].

        What a simulated stack holds besides, counts by order and from the plate, stays as it was traced.
        """
        background = self.background
        if background is not None:
            background = background * (factor if background.ndim == 3 else factor[:, 0, 0])
        return self.replace(
            counts=self.counts * factor,
            variance=None if self.variance is None else self.variance * factor**2,
            background=background,
            parallax=None if self.parallax is None else self.parallax * factor,
        )

    def replace(self, **changes: Any) -> "MicrographStack":
        """Return a validated copy with some fields changed."""
        return replace(self, **changes)


@dataclass(frozen=True, repr=False)
class MicrographSet(Drawable):
    """Several scans of one sample, each with its own raster, azimuth, rotation and instrument.

    Example:
        >>> hx.MicrographSet((stack, stack)).stacks[1].counts
    """

    stacks: tuple[MicrographStack, ...]
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.stacks:
            raise InputFileError("a micrograph set must hold at least one stack, got none")

    def _in_short(self) -> str:
        names = ", ".join(s.name for s in self.stacks[:3]) + (", ..." if len(self.stacks) > 3 else "")
        return f"of {len(self.stacks)} scans: {names}"

    @property
    def is_oblique(self) -> bool:
        """Whether the beam of a scan is oblique, so that heights move pixels from scan to scan."""
        return any(s.instrument.beam.incidence_deg for s in self.stacks)

    def only(self, error: type[HelioError] = InputFileError) -> MicrographStack:
        """Return the only stack; several scans must be aligned first."""
        if len(self.stacks) != 1:
            raise error(
                f"this step needs one stack on one raster, got a set of {len(self.stacks)} scans "
                f"({', '.join(s.name for s in self.stacks)}): align rotated scans first (helio align), or "
                "take one in Python: helio_jax.read(FILE).stacks[0]"
            )
        return self.stacks[0]


Micrographs = MicrographStack | MicrographSet
"""One stack, or one stack per view of a scan."""
