"""Turn expected counts into noisy ones, as an experiment would have recorded them. Settings table `[noise]`.

Flow: simulated `MicrographStack` (noise "expected") -> the same stack with Poisson counts (noise "poisson").
"""

import numpy as np
from pydantic import Field

from helio_jax.errors import SceneError
from helio_jax.micrograph import MicrographStack
from helio_jax.settings import Settings

_STREAM = 0x6E6F697365  # keeps the noise's random numbers apart from the tracer's for equal seeds


class NoiseSettings(Settings):
    """Counting noise, background and gain of the detectors."""

    enabled: bool = True
    """Whether `helio run` adds noise before it reconstructs."""
    background_per_pixel: float | tuple[float, ...] = 0.0
    """Mean counts per pixel that do not come from the sample: one number, or one per detector."""
    gain: float | tuple[float, ...] = 1.0
    """Counts recorded per expected count: one number, or one per detector."""
    seed: int = Field(default=1, ge=0, lt=2**63)
    """Seed of the noise."""

    def problems(self, n_detectors: int) -> list[tuple[str, str]]:
        """Return (key, what is wrong) for the per-detector lists."""
        out = []
        for key, is_wrong, limit in (
            ("background_per_pixel", lambda v: v < 0, ">= 0 counts"),
            ("gain", lambda v: v <= 0, "> 0"),
        ):
            values = np.atleast_1d(getattr(self, key))
            if values.size not in (1, n_detectors):
                out.append(
                    (
                        key,
                        f"must be one number or one per detector ({n_detectors}), got {values.size}: correct the list",
                    )
                )
            if values.size == 0 or np.any(is_wrong(values)):
                out.append((key, f"must be {limit}, got {values.tolist()}: choose such values"))
        return out


def add_noise(stack: MicrographStack, settings: NoiseSettings, seed: int | None = None) -> MicrographStack:
    """Draw Poisson counts of mean gain * expected + background for every observed pixel.

    The variance is that of the data about their unknown truth: the Poisson mean, plus gain^2 times the Monte
    Carlo variance of the expectation. Orders and other components stay expectations, times gain. Applies noise also
    where `settings.enabled` is False: the caller decides.

    Args:
        stack: expected counts (noise "expected").
        settings: background and gain.
        seed: used in place of `settings.seed`.

    Raises:
        SceneError: the stack is noisy already, a list does not fit its detectors, or an expectation is negative.
    """
    if stack.noise != "expected":
        raise SceneError(f"noise can be added only to expected counts, got a stack with noise = {stack.noise!r}")
    n_detectors = stack.shape[0]
    if problems := settings.problems(n_detectors):
        raise SceneError("\n".join(f"noise.{key} {text}" for key, text in problems))
    per_detector = lambda v: np.broadcast_to(np.asarray(v, np.float64), (n_detectors,)).copy()  # noqa: E731
    background, gain = per_detector(settings.background_per_pixel), per_detector(settings.gain)
    observed = stack.is_observed
    assert observed is not None  # set by the stack itself
    mean = gain[:, None, None] * stack.counts + background[:, None, None]
    if np.any(mean[observed] < 0):
        raise SceneError(
            f"expected counts must be >= 0 to add noise, got {mean[observed].min():g}: trace with more rays or raise "
            "noise.background_per_pixel"
        )
    seed = settings.seed if seed is None else seed
    counts = np.full(mean.shape, np.nan)
    counts[observed] = np.random.default_rng([seed, _STREAM]).poisson(mean[observed])
    variance = mean.copy()
    if stack.variance is not None:
        variance += gain[:, None, None] ** 2 * stack.variance
    scaled = {
        key: getattr(stack, key) * gain[:, None, None]
        for key in ("by_order", "effuse", "plate")
        if getattr(stack, key) is not None
    }
    record = settings.model_dump(mode="json") | {"seed": seed, "law": "poisson(gain * expected + background)"}
    return stack.replace(
        counts=counts,
        variance=variance,
        background=background,
        noise="poisson",
        provenance={**stack.provenance, "noise": record},
        **scaled,
    )
