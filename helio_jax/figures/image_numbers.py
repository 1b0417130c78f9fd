"""Numbers of each detector's image: mean, largest count, signal-to-noise ratio, error of the simulation."""

from dataclasses import dataclass

import numpy as np

from helio_jax.arrays import BORDER_WIDTH, border_mask
from helio_jax.micrograph import MicrographStack


@dataclass(frozen=True)
class ImageNumbers:
    """Numbers of one image; counts in the unit of the stack.

    Attributes:
        mean, highest: of the observed counts.
        noise: root mean square standard deviation of one pixel; None: unknown.
        snr: signal above the background over the standard deviation of one pixel, on the image's border; of
            expected counts, with the noise of counting alone. None: the background or the noise is unknown.
    """

    mean: float
    highest: float
    noise: float | None
    snr: float | None

    @property
    def relative_error(self) -> float | None:
        """Noise over the mean; None: unknown."""
        return None if self.noise is None or self.mean <= 0 else self.noise / self.mean


def image_numbers(stack: MicrographStack) -> list[ImageNumbers]:
    """Compute the numbers of every image of a stack, in the order of its detectors."""
    border = border_mask(stack.shape[1:], BORDER_WIDTH)
    is_known = stack.noise != "measured" or stack.background is not None or stack.calibration is not None
    out = []
    for k, is_seen in enumerate(stack.is_observed):
        counts, at_border = stack.counts[k][is_seen], is_seen & border
        if not counts.size:
            out.append(ImageNumbers(np.nan, np.nan, None, None))
            continue
        noise = None if stack.variance is None else float(np.sqrt(stack.variance[k][is_seen].mean()))
        variance = stack.counts[k] if stack.noise == "expected" else None if noise is None else stack.variance[k]  # type: ignore[index]
        snr = None
        if is_known and variance is not None and at_border.any() and (spread := variance[at_border].mean()) > 0:
            snr = float(stack.signal[k][at_border].mean() / np.sqrt(spread))
        out.append(ImageNumbers(float(counts.mean()), float(counts.max()), noise, snr))
    return out
