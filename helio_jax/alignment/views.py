"""Pictures of rotated scans for the automatic alignment, resampled in the common frame at any motion.

A view is one scan; its pictures (one per detector) are centred and scaled, so gains and offsets do not matter.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage

from helio_jax.alignment.resample import SplineImage, smooth
from helio_jax.alignment.rigid import Rigid
from helio_jax.arrays import pitch, robust_std
from helio_jax.micrograph import MicrographStack

_EDGE_SIGMA = 1.5
_SPIKE = 5.0


@dataclass(frozen=True, eq=False)
class Frame:
    """The common frame's raster for alignment: the first scan's, with a margin on all sides.

    Attributes:
        points: beam positions [y, x, 2], um.
        step: pitch [um].
        center: middle of the raster [2], um.
        inside: True on the first scan's own raster [y, x].
    """

    points: np.ndarray
    step: float
    center: np.ndarray
    inside: np.ndarray

    @classmethod
    def around_view(cls, view: "View", margin_um: float) -> "Frame":
        """Make the raster of a scan and a margin; square pixels of the finer of its pitches."""
        step = min(pitch(view.x), pitch(view.y))
        n = int(np.ceil(margin_um / step))
        axes = [np.arange(-n, round(np.ptp(a) / step) + n + 1) * step + a[0] for a in (view.x, view.y)]
        points = np.stack(np.meshgrid(*axes), -1)
        inside = np.ones(points.shape[:2], bool)
        for axis, own in enumerate((view.x, view.y)):
            inside &= (points[..., axis] >= own[0] - 0.5 * step) & (points[..., axis] <= own[-1] + 0.5 * step)
        return cls(points, step, np.array([a.mean() for a in axes]), inside)


@dataclass(frozen=True, eq=False)
class View:
    """One scan's pictures, standardised.

    Attributes:
        name: of the scan.
        pictures: zero median, unit robust spread [detector, y, x]; spikes cut.
        known: True where recorded [detector, y, x].
        x, y: beam positions [um].
    """

    name: str
    pictures: np.ndarray
    known: np.ndarray
    x: np.ndarray
    y: np.ndarray
    _kept: dict[tuple[float, float], list[SplineImage]] = field(default_factory=dict)

    @classmethod
    def of(cls, stack: MicrographStack) -> "View":
        """Make the view of a scan."""
        pictures = []
        for image, known in zip(stack.counts, stack.is_observed, strict=True):
            values = image[known]
            low, middle, high = np.quantile(values, [0.16, 0.5, 0.84]) if values.size else (0.0, 0.0, 1.0)
            pictures.append(_despiked(np.where(known, (image - middle) / (0.5 * (high - low) or 1.0), 0.0)))
        return cls(stack.name, np.stack(pictures), stack.is_observed, stack.x, stack.y)

    @property
    def center(self) -> np.ndarray:
        """Middle of the field [2], um."""
        return np.array([self.x.mean(), self.y.mean()])

    def band_passed(self, sigma_um: float, band: float) -> list[SplineImage]:
        """Smooth the pictures by a Gaussian of `sigma_um` less one `band` times as wide.

        This removes slow shades, drift and the soft ends of masked areas.
        """
        if (sigma_um, band) not in self._kept:
            sigma = sigma_um / min(pitch(self.x), pitch(self.y))
            self._kept[sigma_um, band] = [
                SplineImage.of(smooth(p, k, sigma) - smooth(p, k, band * sigma), k, self.x, self.y)
                for p, k in zip(self.pictures, self.known, strict=True)
            ]
        return self._kept[sigma_um, band]

    def edges(self) -> SplineImage:
        """Compute the strength of the edges of all detectors."""
        edges = sum(np.sqrt(ndimage.gaussian_gradient_magnitude(p, _EDGE_SIGMA)) for p in self.pictures)
        known = ndimage.binary_erosion(self.known.all(0), iterations=2 * round(_EDGE_SIGMA))
        return SplineImage.of(np.asarray(edges), np.asarray(known), self.x, self.y)


def resample_images(images: list[SplineImage], motion: Rigid, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Resample images of a view in the common frame [image, y, x]; also where they are known."""
    places = motion.apply(frame.points)
    out = [image.at(places) for image in images]
    return np.stack([v for v, _ in out]), np.stack([k for _, k in out])


def _despiked(image: np.ndarray) -> np.ndarray:
    """Replace pixels that differ from the median of their neighbourhood by five robust standard deviations or more."""
    median = ndimage.median_filter(image, 3, mode="nearest")
    difference = np.abs(image - median)
    return np.where(difference > _SPIKE * max(float(robust_std(difference)), 1e-12), median, image)
