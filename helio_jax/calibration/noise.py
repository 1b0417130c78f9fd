"""Turn expected counts into noisy ones, as an experiment would have recorded them. Settings table `[noise]`.

Flow: simulated `MicrographStack` (noise "expected") -> the same stack with Poisson counts (noise "poisson"), or with
only what a measured file contains (noise "measured").
"""

from typing import Literal

import numpy as np
from pydantic import Field

from helio_jax.calibration.response import ScanTime, lagging, slow_drift
from helio_jax.errors import SceneError
from helio_jax.micrograph import SIMULATED_PARTS, MicrographStack
from helio_jax.settings import Settings

_STREAM = 0x6E6F697365  # keeps the noise's random numbers apart from the tracer's for equal seeds
_DRIFT_STREAM = 0x6472696674
_LIMITS = {
    "background_per_pixel": (lambda v: v < 0, ">= 0 counts"),
    "gain": (lambda v: v <= 0, "> 0"),
    "lag_s": (lambda v: v < 0, ">= 0 s"),
    "drift_per_pixel": (lambda v: v < 0, ">= 0 counts"),
}


class NoiseSettings(Settings):
    """Counting noise, background, gain, lag and drift of the detectors."""

    enabled: bool = True
    """Whether `helio run` adds noise before it reconstructs."""
    background_per_pixel: float | tuple[float, ...] = 0.0
    """Mean counts per pixel that do not come from the sample: one number, or one per detector."""
    gain: float | tuple[float, ...] = 1.0
    """Counts recorded per expected count: one number, or one per detector."""
    lag_s: float | tuple[float, ...] = 0.0
    """Time constant of an exponential lag: one number, or one per detector; 0: none [s]."""
    drift_per_pixel: float | tuple[float, ...] = 0.0
    """Standard deviation of a slow drift of the background: one number, or one per detector [counts per pixel]."""
    drift_time_s: float = Field(default=3600.0, gt=0.0, le=1e9)
    """Correlation time of the drift [s]."""
    dwell_s: float | None = Field(default=None, gt=0.0, le=1e6)
    """Counting time of a pixel; needed for lag and drift, it does not change the counts [s]."""
    move_s: float = Field(default=0.0, ge=0.0, le=1e6)
    """Time to reach a pixel, without counting [s]."""
    flyback_s: float = Field(default=0.0, ge=0.0, le=1e6)
    """Further time to go back to the beginning of a line [s]."""
    fast_axis: Literal["x", "y"] = "x"
    """Axis along which the scan moves fastest, from low to high."""
    as_measured: bool = False
    """Remove what a measured file does not contain: orders, masks, background, number of atoms."""
    seed: int = Field(default=1, ge=0, lt=2**63)
    """Seed of the noise."""

    def problems(self, n_detectors: int) -> list[tuple[str, str]]:
        """Check the per-detector lists and the times; return (key, message) pairs."""
        out = []
        for key, (is_wrong, limit) in _LIMITS.items():
            values = np.atleast_1d(getattr(self, key))
            if values.size not in (1, n_detectors):
                wanted = f"must be one number or one per detector ({n_detectors})"
                out.append((key, f"{wanted}, got {values.size}: correct the list"))
            if values.size == 0 or np.any(is_wrong(values)):
                out.append((key, f"must be {limit}, got {values.tolist()}: choose such values"))
        needs_time = [key for key in ("lag_s", "drift_per_pixel") if np.any(np.atleast_1d(getattr(self, key)))]
        if needs_time and self.dwell_s is None:
            out.append(("dwell_s", f"is needed for noise.{needs_time[0]}: give the counting time of a pixel"))
        return out

    def per_detector(self, key: str, n_detectors: int) -> np.ndarray:
        """Broadcast a setting to all detectors [detector]."""
        return np.broadcast_to(np.asarray(getattr(self, key), np.float64), (n_detectors,)).copy()

    @property
    def time(self) -> ScanTime:
        """Times of the pixels; the dwell time is 1 s where none is given, for then nothing depends on it."""
        return ScanTime(self.dwell_s or 1.0, self.move_s, self.flyback_s, self.fast_axis)


def add_noise(stack: MicrographStack, settings: NoiseSettings, seed: int | None = None) -> MicrographStack:
    """Draw Poisson counts of mean gain * lagging(expected) + background + drift for every observed pixel.

    The variance is that of the data about their unknown truth: the Poisson mean, plus gain^2 times the Monte
    Carlo variance of the expectation; the drift is not in it. Orders and other components stay expectations, with lag
    and gain. Applies noise also where `settings.enabled` is False: the caller decides.

    Where dwell times differ (`dwell_map`), the counts of each pixel's own time are drawn and scaled.

    Args:
        stack: expected counts (noise "expected").
        settings: background, gain, lag, drift.
        seed: used in place of `settings.seed`.

    Raises:
        SceneError: the stack is noisy already, a list does not fit its detectors, an expectation is negative, or lag or
            another dwell time is asked for where dwell times differ.
    """
    if stack.noise != "expected":
        raise SceneError(f"noise can be added only to expected counts, got a stack with noise = {stack.noise!r}")
    n_detectors = stack.shape[0]
    if problems := settings.problems(n_detectors):
        raise SceneError("\n".join(f"noise.{key} {text}" for key, text in problems))
    background, gain, lag, drift = (
        settings.per_detector(key, n_detectors) for key in ("background_per_pixel", "gain", "lag_s", "drift_per_pixel")
    )
    seed = settings.seed if seed is None else seed
    share = _dwell_share(stack, settings)

    def recorded(images: np.ndarray) -> np.ndarray:
        """Apply lag and gain to images [..., detector, y, x]."""
        lagged = [lagging(images[..., k, :, :], lag[k], settings.time) for k in range(n_detectors)]
        return gain[:, None, None] * np.stack(lagged, -3) if lag.any() else gain[:, None, None] * images

    observed = stack.is_observed
    mean = recorded(stack.counts) + background[:, None, None]
    if drift.any():
        shape = slow_drift(mean.shape, settings.drift_time_s, settings.time, [seed, _DRIFT_STREAM])
        mean = mean + drift[:, None, None] * shape
    if np.any(mean[observed] < 0):
        raise SceneError(
            f"expected counts must be >= 0 to add noise, got {mean[observed].min():g}: trace with more rays or raise "
            "noise.background_per_pixel"
        )
    counts = np.full(mean.shape, np.nan)
    counts[observed] = np.random.default_rng([seed, _STREAM]).poisson((mean * share)[observed])
    counts, variance = counts / share, mean / share
    if stack.variance is not None:
        variance += gain[:, None, None] ** 2 * stack.variance
    components = {key: getattr(stack, key) for key in ("by_order", "effuse", "plate")}
    variances = {key: getattr(stack, key) for key in ("by_order_variance", "effuse_variance")}
    law = "poisson(gain * lag(expected) + background + drift)"
    record = settings.model_dump(mode="json") | {"seed": seed, "law": law}
    noisy = stack.replace(
        counts=counts,
        variance=variance,
        background=background,
        noise="poisson",
        dwell=settings.dwell_s if stack.dwell_map is None else stack.dwell,
        fast_axis=settings.fast_axis,
        provenance={**stack.provenance, "noise": record},
        **{key: recorded(image) for key, image in components.items() if image is not None},
        **{key: gain[:, None, None] ** 2 * image for key, image in variances.items() if image is not None},
    )
    return _as_measured(noisy) if settings.as_measured else noisy


def _dwell_share(stack: MicrographStack, settings: NoiseSettings) -> np.ndarray:
    """Return the dwell time of every pixel over the stack's, 1 where it was not counted [y, x]."""
    if stack.dwell_map is None or stack.dwell is None:
        return np.ones(stack.shape[1:])
    if np.any(np.atleast_1d(settings.lag_s)) or settings.dwell_s not in (None, stack.dwell):
        raise SceneError(
            f"noise: the pixels of {stack.name} have dwell times of their own, scaled to {stack.dwell:g} s, got "
            f"lag_s = {settings.lag_s} and dwell_s = {settings.dwell_s}: set noise.lag_s = 0 and remove noise.dwell_s"
        )
    return np.where(stack.dwell_map > 0.0, stack.dwell_map / stack.dwell, 1.0)


def _as_measured(stack: MicrographStack) -> MicrographStack:
    """Keep of noisy counts only what an experiment knows; the variance is then that of the counts."""
    unknown = ("background", *SIMULATED_PARTS, "n_rays")
    variance = np.where(stack.is_observed, np.maximum(stack.counts, 1.0), 0.0)
    return stack.replace(noise="measured", variance=variance, **dict.fromkeys(unknown))
