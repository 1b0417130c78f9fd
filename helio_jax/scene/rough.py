"""Random rough samples: a Gaussian, self-affine surface of given rms height, correlation length and Hurst exponent.

Spectral density W(k) = rms^2 xi^2 / (2 pi) (1 + a k^2 xi^2)^-(1 + H) up to k_c = pi / resolution, with
a = (1 - (1 + a k_c^2 xi^2)^-H) / (2 H), so that its integral is rms^2. Without the cut-off the autocorrelation is
rms^2 2^(1-H) / Gamma(H) (s r / xi)^H K_H(s r / xi), s = sqrt(2 H): rms^2 exp(-r / xi) for H = 1/2.
Source: Palasantzas, Phys. Rev. B 48 (1993) 14472, eqs. 3 and 4; autocorrelation: own derivation (Hankel transform),
tests/unit/test_rough.py.
"""

import math
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from helio_jax.scene import surfaces
from helio_jax.scene.body import Body
from helio_jax.scene.shapes import Length, SubstrateSample

MAX_POINTS = 1500
"""Largest number of points along one side: 4.5 million triangles."""
_STREAM = 0x726F756768  # separates these random numbers from others with the same seed
_MARGIN = 6.0
"""Margin of the periodic surface that is cut off, so that opposite borders are independent [correlation lengths]."""


class RoughSample(SubstrateSample):
    """A random rough square in the substrate z = 0, with normally distributed heights of mean zero."""

    kind: Literal["rough"] = "rough"
    rms_um: Length
    """Root mean square height of the drawn surface about its mean [um]."""
    correlation_length_um: Length
    """Lateral correlation length xi: beyond it heights are independent [um]."""
    hurst: float = Field(default=0.7, gt=0.0, le=1.0)
    """Hurst exponent: jagged (near 0) to smooth (1) below the correlation length."""
    seed: int = Field(default=1, ge=0, lt=2**63)
    """Seed of the random numbers."""
    patch_um: Length | None = None
    """Side of the rough square; default: the whole substrate. A wall joins it to the substrate around [um]."""
    resolution_um: Length | None = None
    """Distance of the grid points, the finest roughness; default: an eighth of the correlation length [um]."""

    @model_validator(mode="after")
    def _is_representable(self) -> "RoughSample":
        problems = []
        if self.side > self.size_um:
            problems.append(f"patch_um must be <= size_um = {self.size_um:g} um, got {self.side:g}: enlarge size_um")
        if self.step > 0.5 * self.correlation_length_um:
            problems.append(
                f"resolution_um must be <= half of correlation_length_um = {self.correlation_length_um:g} um, got "
                f"{self.step:g}: make it finer"
            )
        if self.side / self.step > MAX_POINTS - 1 or self.side / self.step < 8:
            problems.append(
                f"the rough square must be 8 to {MAX_POINTS - 1} times resolution_um wide, got {self.side:g} / "
                f"{self.step:g} = {self.side / self.step:.0f}: set patch_um (now {self.patch_um}) to what the scan "
                f"covers, or resolution_um (now {self.resolution_um})"
            )
        if problems:
            raise ValueError("\n".join(problems))
        return self

    @property
    def side(self) -> float:
        """Side of the rough square [um]."""
        return self.size_um if self.patch_um is None else self.patch_um

    @property
    def step(self) -> float:
        """Nominal distance of the grid points [um]."""
        return self.correlation_length_um / 8.0 if self.resolution_um is None else self.resolution_um

    @property
    def shape_top(self) -> float | None:
        """Unknown before the surface is drawn."""
        return None

    def build_shape(self, base_dir: Path = Path()) -> Body:
        """Draw and triangulate the surface."""
        n_cells = math.ceil(self.side / self.step - 1e-9)
        axis = (np.arange(n_cells + 1) - 0.5 * n_cells) * (self.side / n_cells)
        height = rough_heights(
            n_cells + 1, self.side / n_cells, self.rms_um, self.correlation_length_um, self.hurst, self.seed
        )
        reach = None if self.side == self.size_um else 0.5 * self.size_um
        return surfaces.surface_body(*np.meshgrid(axis, axis), height, reach, level=0.0).with_material(self.material)


def rough_heights(n: int, step: float, rms: float, correlation_length: float, hurst: float, seed: int) -> np.ndarray:
    """Draw heights [n, n] of a random surface, um, with mean 0 and root mean square `rms` exactly.

    Args:
        n: points along each side.
        step: distance of neighbouring points [um].
        rms, correlation_length, hurst: rms height [um], xi [um] and H.
        seed: of the random numbers.
    """
    from scipy.fft import next_fast_len

    m: int = next_fast_len(n + math.ceil(_MARGIN * correlation_length / step), real=True)  # type: ignore[assignment]
    k = np.hypot(*np.meshgrid(2 * np.pi * np.fft.rfftfreq(m, step), 2 * np.pi * np.fft.fftfreq(m, step)))
    amplitude = np.sqrt(spectrum(k, np.pi / step, correlation_length, hurst))
    noise = np.random.default_rng([seed, _STREAM]).standard_normal((m, m))
    height = np.fft.irfft2(np.fft.rfft2(noise) * amplitude, s=(m, m))[:n, :n]
    height -= height.mean()
    return height * (rms / np.sqrt(np.mean(height**2)))


def spectrum(k: np.ndarray, cutoff: float, correlation_length: float, hurst: float) -> np.ndarray:
    """Compute W(k) of a surface of rms 1 [um^2]; its integral over all wave vectors (d kx d ky) is 1.

    Args:
        k: lengths of wave vectors [rad/um].
        cutoff: k_c, above which W is zero [rad/um].
        correlation_length, hurst: xi [um] and H.
    """
    a, reach = 1.0 / (2.0 * hurst), (cutoff * correlation_length) ** 2
    for _ in range(200):  # a contraction: converges from above
        a, before = (1.0 - (1.0 + a * reach) ** -hurst) / (2.0 * hurst), a
        if abs(a - before) < 1e-14:
            break
    w = correlation_length**2 / (2.0 * np.pi) * (1.0 + a * (k * correlation_length) ** 2) ** -(1.0 + hurst)
    return np.where(k <= cutoff, w, 0.0)
