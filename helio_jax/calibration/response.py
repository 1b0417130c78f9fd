"""Response of the detectors in scan time: exponential lag and slow drift.

Time runs along the fast axis from the first column (or row), line after line, each in the same direction. A pixel takes
`move` seconds without counting and `dwell` seconds of counting; each new line begins `flyback` seconds later. During
`move` and `flyback` the detector sees the next pixel.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ScanTime:
    """When the pixels of a scan are counted [s].

    Attributes:
        dwell: counting time of a pixel.
        move: time before each pixel.
        flyback: further time before each line.
        fast_axis: "x" or "y".
    """

    dwell: float
    move: float
    flyback: float
    fast_axis: str

    def in_time(self, images: np.ndarray) -> np.ndarray:
        """Order images [..., y, x] as lines in time [..., line, pixel], or back."""
        return images if self.fast_axis == "x" else np.swapaxes(images, -1, -2)

    @property
    def step(self) -> float:
        """From one pixel to the next within a line [s]."""
        return self.dwell + self.move


def lagging(images: np.ndarray, constant: float, time: ScanTime) -> np.ndarray:
    """Compute the mean counts of a first-order detector (r' = (signal - r) / constant) for a signal.

    The detector has settled on the first pixel when the scan begins. Valid for any ratio of the times.

    Args:
        images: signal of every pixel [..., y, x].
        constant: time constant [s]; 0: no lag.
        time: of the scan.

    Source: own derivation: r = s + (r0 - s) exp(-t / constant), averaged over the dwell time;
        tests/unit/test_response.py.
    """
    if constant == 0.0:
        return images
    from scipy.signal import lfilter

    signal = time.in_time(images)
    keep, back, moved = (np.exp(-t / constant) for t in (time.step, time.flyback, time.move))
    # remaining fraction of the old signal, averaged over the dwell time
    averaged = -np.expm1(-time.dwell / constant) * constant / time.dwell * moved
    out = np.empty_like(signal)
    last = signal[..., 0, 0]
    for line in range(signal.shape[-2]):
        s = signal[..., line, :]
        start = s[..., 0] + (last - s[..., 0]) * back
        after = np.asarray(lfilter([1.0 - keep], [1.0, -keep], s, zi=keep * start[..., None])[0])
        before = np.concatenate([start[..., None], after[..., :-1]], -1)
        out[..., line, :] = s + (before - s) * averaged
        last = after[..., -1]
    return time.in_time(out)


def slow_drift(shape: tuple[int, ...], constant: float, time: ScanTime, seed: list[int]) -> np.ndarray:
    """Draw a random drift of mean 0 and standard deviation 1 for each of the images [..., y, x].

    Normal, correlated in time as exp(-t / constant) (an Ornstein-Uhlenbeck process, Phys. Rev. 36 (1930) 823), which is
    sampled exactly at the middle of every pixel's dwell time.
    """
    from scipy.signal import lfilter

    noise = time.in_time(np.random.default_rng(seed).standard_normal(shape))
    keep = np.exp(-time.step / constant)
    first = np.exp(-(time.step + time.flyback) / constant)
    out = np.empty_like(noise)
    for line in range(noise.shape[-2]):
        push = noise[..., line, :] * np.sqrt(1.0 - keep**2)
        if line == 0:
            push[..., 0] = noise[..., 0, 0]
        else:
            push[..., 0] = first * out[..., line - 1, -1] + np.sqrt(1.0 - first**2) * noise[..., line, 0]
        out[..., line, :] = lfilter([1.0], [1.0, -keep], push)
    return time.in_time(out)
