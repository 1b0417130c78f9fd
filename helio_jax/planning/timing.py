"""Time of an acquisition from its pixels, and what several detectors save. Numbers in, numbers out.

Every pixel is counted for `dwell`, after the stage has moved to it and rested for `pause`. Detectors count at the same
time, so that their number only sets how many scans a set of images takes.
"""

import math
from dataclasses import dataclass, replace

from helio_jax.errors import InputFileError, SceneError


@dataclass(frozen=True)
class Timing:
    """Times of an acquisition [s], all >= 0, `dwell` > 0.

    Attributes:
        dwell: counting time of a pixel.
        pause: rest before each pixel is counted.
        move: time to move to a pixel; where it is measured over a whole scan, with the share of the line changes.
        flyback: further time before each line.
        change: time between two scans: rotation of the sample, move to the next window.

    Raises:
        SceneError: a time is negative or not finite, or `dwell` is 0.
    """

    dwell: float
    pause: float = 0.0
    move: float = 0.0
    flyback: float = 0.0
    change: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value >= 0.0) or (name == "dwell" and value == 0.0):
                limit = "> 0" if name == "dwell" else ">= 0"
                raise SceneError(f"{name} must be a finite time {limit} s, got {value:g}: correct it")

    def at_dwell(self, dwell: float) -> "Timing":
        """Return the same stage with another counting time [s]."""
        return replace(self, dwell=dwell)

    def seconds(self, n_lines: int, n_per_line: int, n_scans: int = 1) -> float:
        """Compute the time of `n_scans` scans of so many lines and pixels a line [s]."""
        line = n_per_line * (self.dwell + self.pause + self.move) + self.flyback
        return n_scans * n_lines * line + (n_scans - 1) * self.change


def measure_move(seconds: float, n_pixels: int, dwell: float, pause: float) -> float:
    """Compute the time per pixel that a finished scan took beside dwell and pause [s].

    Line changes are in it, so that it predicts scans of about as many pixels a line.

    Args:
        seconds: duration of the scan.
        n_pixels: of the scan.
        dwell, pause: of a pixel [s].

    Raises:
        InputFileError: the scan was shorter than its dwell times and pauses.
    """
    move = seconds / n_pixels - dwell - pause
    if move < 0.0:
        raise InputFileError(
            f"{n_pixels} pixels of {dwell:g} s dwell and {pause:g} s pause take {n_pixels * (dwell + pause):.0f} s or "
            f"more, got a scan of {seconds:.0f} s: correct the dwell time or the pause"
        )
    return move


def scans_needed(n_images: int, n_detectors: int) -> int:
    """Compute how many scans record so many images, one image per detector and scan."""
    return math.ceil(n_images / n_detectors)


def seconds_per_height(seconds: float, n_pixels: int, share: float = 1.0) -> float:
    """Compute the time per reconstructed pixel [s]: of all scans, over the share of the raster that has heights.

    Raises:
        SceneError: `share` is not within 0 to 1, or 0.
    """
    if not 0.0 < share <= 1.0:
        raise SceneError(f"the reconstructed share of the pixels must be > 0 and <= 1, got {share:g}: correct it")
    return seconds / (n_pixels * share)
