"""The detectors' read-out: from detection probabilities to readings, and what they read without the sample's signal.

A reading also holds helium that came from elsewhere. It changes slowly in time and, since the moving sample changes
how the gas around it escapes, smoothly with the position of the stage: low polynomials of both. From line to line it
jumps a little. Time runs along the slow axis of the scan.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.polynomial.legendre import legvander


class ScanOrder(NamedTuple):
    """When the pixels were recorded.

    Attributes:
        slow_axis: of the raster, along which the scan moves slowly, 0 (y) or 1 (x).
        time: where the images are aligned scans of their own, when each recorded a pixel, -1 to 1 [detector, y, x].
    """

    slow_axis: int = 0
    time: np.ndarray | None = None

    def thinned(self, thin: tuple[slice, ...]) -> "ScanOrder":
        """Keep some rows and columns."""
        return self if self.time is None else self._replace(time=self.time[:, *thin])


class Readout(eqx.Module):
    """How detectors read: gain * probability + offset + drift + pedestal + scan lines.

    Attributes:
        gain: reading per detected probability, e.g. beam atoms per pixel times efficiency.
        offset: constant background, in units of the reading.
        drift: amplitudes of the slow drift.
        drift_modes: its shapes over the raster, from `drift_modes`; first axis 1 where all detectors share them.
        pedestal: amplitudes of the background that depends on the stage position.
        pedestal_modes: its shapes, from `pedestal_modes`.
        lines: offset of each scan line.
        slow_axis: raster axis across the scan lines, 0 (y) or 1 (x), static.

    Example:
        >>> hx.render(height, optics, raster, readout=hx.Readout(np.full(3, 35_000.0), np.zeros(3)))
    """

    gain: Float[Any, " detector"]
    offset: Float[Any, " detector"]
    drift: Float[Any, "detector mode"] | None = None
    drift_modes: Float[Any, "same mode y x"] | None = None
    pedestal: Float[Any, "detector mode"] | None = None
    pedestal_modes: Float[Any, "same mode y x"] | None = None
    lines: Float[Any, "detector line"] | None = None
    slow_axis: int = eqx.field(static=True, default=0)

    @classmethod
    def ideal(cls, n_detectors: int, gain: float = 1.0) -> "Readout":
        """Make detectors of one gain without background."""
        return cls(np.full(n_detectors, gain), np.zeros(n_detectors))

    @property
    def background(self) -> Any:
        """Reading without signal: [detector, y, x], or [detector, 1, 1] where only the offset is known."""
        total = jnp.asarray(self.offset)[:, None, None]
        for amplitude, modes in ((self.drift, self.drift_modes), (self.pedestal, self.pedestal_modes)):
            if amplitude is not None and amplitude.shape[1] and modes is not None:
                total = total + jnp.sum(jnp.asarray(amplitude)[:, :, None, None] * modes, 1)
        if self.lines is not None and self.lines.shape[1]:
            total = total + jnp.expand_dims(jnp.asarray(self.lines), 2 - self.slow_axis)
        return total

    def __call__(self, probability: Any) -> Any:
        """Compute the expected readings [detector, y, x] of detection probabilities."""
        return jnp.asarray(self.gain)[:, None, None] * probability + self.background


def drift_modes(shape: tuple[int, int], order: ScanOrder, degrees: tuple[int, int]) -> np.ndarray:
    """Compute the shapes of the slow drift [detector or 1, mode, y, x], the constant left out.

    Products of Legendre polynomials along the slow and the fast axis, of degree (i, j) with i / slow degree + j / fast
    degree <= 1, each divided by its degree i + j, so that one prior deviation serves all of a smooth drift, and of a
    root mean square value of 1 / (i + j). Of aligned scans: those of each one's own time, up to the slow degree.

    Args:
        shape: of the raster (y, x).
        order: in which the pixels were recorded.
        degrees: largest degree along the slow and the fast axis.

    Example:
        >>> from helio_jax.forward.readout import ScanOrder
        >>> hx.drift_modes(stack.shape[1:], ScanOrder(), (4, 3)).shape
    """
    if order.time is not None:
        degree = np.arange(1, degrees[0] + 1)
        modes = legvander(order.time, degrees[0])[..., 1:] * np.sqrt(2.0 * degree + 1.0) / degree
        return np.moveaxis(modes, -1, 1)
    slow_axis = order.slow_axis
    slow, fast = (np.linspace(-1.0, 1.0, n) for n in (shape if slow_axis == 0 else shape[::-1]))
    grid = _products(*np.meshgrid(slow, fast, indexing="ij"), degrees)
    return (grid if slow_axis == 0 else grid.swapaxes(1, 2))[None]


def pedestal_modes(stage_x: np.ndarray, stage_y: np.ndarray, degree: int = 3) -> np.ndarray:
    """Compute the shapes of a background that depends on the stage position [1, mode, y, x], the constant left out.

    Args:
        stage_x, stage_y: stage coordinates of every pixel [y, x], in units of half the range that all scans of the
            campaign share, about its middle (-1 to 1), so that they can share amplitudes.
        degree: largest total degree of the polynomial.

    Example:
        >>> hx.pedestal_modes(*np.meshgrid(x, y), degree=2).shape
    """
    return _products(stage_x, stage_y, (degree, degree))[None]


def _products(u: np.ndarray, v: np.ndarray, degrees: tuple[int, int]) -> np.ndarray:
    """Compute products of normalised Legendre polynomials in u and v [mode, y, x], divided by their total degree."""
    first, second = (
        legvander(a, d) * np.sqrt(2.0 * np.arange(d + 1) + 1.0) for a, d in zip((u, v), degrees, strict=True)
    )
    modes = [
        first[..., i] * second[..., j] / (i + j)
        for i in range(degrees[0] + 1)
        for j in range(degrees[1] + 1)
        if i + j > 0 and i * degrees[1] + j * degrees[0] <= degrees[0] * degrees[1]
    ]
    return np.array(modes).reshape(-1, *u.shape)
