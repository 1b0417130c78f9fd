"""Scattering laws of the render model: density per steradian over that of the cosine law, differentiable (JAX).

A law is a small pytree of numbers with two methods: `relative` is its value, `terms` the same law for the tracer. All
atoms leave again: every law integrates to 1. `mean_over_aperture` averages the value over what an aperture subtends
near the plate; where the sample masks part of an aperture, the mean is that of the whole one. No law: the cosine law.
"""

import math
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from helio_jax.forward.optics import Optics
from helio_jax.scene.scattering import COSINE_LAW, BroadSpecularLaw, CosinePowerLaw, RoughDiffuseLaw, Term, tabulated

MIN_COS = 0.05
"""Facets seen under a smaller cosine take the value of this one: powers of the cosine have no slope at the horizon."""
MIN_WIDTH_DEG = 5.0
"""Least width of a lobe [deg]: a narrower one varies too much over an aperture."""
KNOTS_DEG = np.array([0.0, 20.0, 35.0, 50.0, 62.0, 74.0, math.degrees(math.acos(MIN_COS))])
"""Angles to the normal at which `MonotoneLaw` has its exponents [deg]."""
_TURN = np.arange(6) * math.pi / 3.0
POINTS = np.vstack([np.zeros(2), math.sqrt(2.0 / 3.0) * np.stack([np.cos(_TURN), np.sin(_TURN)], 1)])
"""Points on the unit disc whose weighted mean is exact for polynomials up to degree 5 [point, 2] ..."""
WEIGHTS = np.array([0.25, *[0.125] * 6])
"""... and their weights. Source: Stroud, Approximate Calculation of Multiple Integrals (1971), S2: 5-1."""
_FON = 0.0571085289, 0.491881867, -0.332181442, 0.0714429953
_EON_A = 0.5 - 2.0 / (3.0 * math.pi)
_EON_B = 2.0 / 3.0 - 28.0 / (15.0 * math.pi)
_NORM_DEGREE, _NORM_ANGLES = 16, 240


def _safe(cos: Any) -> Any:
    return jnp.maximum(cos, MIN_COS)


def _number(value: Any) -> Any:
    """Make a traced number of a Python one, which would be a constant of what is compiled."""
    return value if hasattr(value, "dtype") else np.asarray(value, float)


class PowerLaw(eqx.Module):
    """cos^(1 + m) of the angle to the normal.

    Attributes:
        exponent: m; 0 is the cosine law.

    Example:
        >>> hx.render(height, optics, raster, law=hx.PowerLaw(0.1))
    """

    exponent: Any = eqx.field(converter=_number)

    def relative(self, cos_in: Any, cos_out: Any, along: Any) -> jax.Array:
        """Compute the density over that of the cosine law.

        Args:
            cos_in: cosine of the angle between the normal and the way back to the source.
            cos_out: cosine of the angle between the normal and the direction.
            along: scalar product of the direction and that of the incoming atom.
        """
        return (1.0 + 0.5 * self.exponent) * _safe(cos_out) ** self.exponent

    def terms(self) -> tuple[Term, ...]:
        """Make the law of the tracer."""
        return CosinePowerLaw(exponent=float(np.clip(self.exponent, -0.99, 50.0))).terms()


class LobeLaw(eqx.Module):
    """The cosine law, and for a share of the atoms a lobe cos(theta) exp(-g^2 / (2 s^2)), g the angle to the mirror's.

    Attributes:
        share: of the atoms in the lobe; 0 is the cosine law.
        width_deg: s [deg], at least `MIN_WIDTH_DEG`.

    Example:
        >>> hx.render(height, optics, raster, law=hx.LobeLaw(0.1, 30.0))
    """

    share: Any = eqx.field(converter=_number)
    width_deg: Any = eqx.field(converter=_number)

    def relative(self, cos_in: Any, cos_out: Any, along: Any) -> jax.Array:
        """Compute the density over that of the cosine law; arguments as those of `PowerLaw.relative`."""
        sigma = jnp.radians(jnp.maximum(self.width_deg, MIN_WIDTH_DEG))
        lobe = jnp.exp(-0.5 * _angle_squared(along + 2.0 * cos_in * cos_out) / sigma**2)
        return 1.0 - self.share + self.share * jnp.pi * lobe / _lobe_norm(cos_in, sigma)

    def terms(self) -> tuple[Term, ...]:
        """Make the law of the tracer; a negative share is none."""
        share = min(float(self.share), 1.0)
        if share <= 0.0:
            return COSINE_LAW
        width = float(np.clip(self.width_deg, MIN_WIDTH_DEG, 180.0))
        return BroadSpecularLaw(sigma_deg=width, diffuse_fraction=1.0 - share).terms()


class RoughLaw(eqx.Module):
    """The energy-preserving Oren-Nayar model (EON) at albedo 1: a diffuse surface that is rough below the beam's spot.

    Attributes:
        roughness: r of the model, about the standard deviation of the slope angles over pi/2; 0 is the cosine law.

    Source: Portsmouth, Kutz, Hill, JCGT 14 (2025) 1, with their polynomial of the albedo.

    Example:
        >>> hx.render(height, optics, raster, law=hx.RoughLaw(0.2))
    """

    roughness: Any = eqx.field(converter=_number)

    def relative(self, cos_in: Any, cos_out: Any, along: Any) -> jax.Array:
        """Compute the density over that of the cosine law; arguments as those of `PowerLaw.relative`."""
        s = -along - cos_in * cos_out
        single = jnp.where(s > 0.0, s / jnp.maximum(_safe(cos_in), cos_out), s)
        # (1 - E_in) (1 - E_out) / (1 - E_mean) with the common factors A r divided out, so that r = 0 is regular
        again = _missing(cos_in) * _missing(cos_out) / (_EON_A - _EON_B)
        return (1.0 + self.roughness * (single + again)) / (1.0 + _EON_A * self.roughness)

    def terms(self) -> tuple[Term, ...]:
        """Make the law of the tracer; a negative roughness is none."""
        return RoughDiffuseLaw(roughness=float(np.clip(self.roughness, 0.0, 1.0))).terms()


class MonotoneLaw(eqx.Module):
    """A density f(theta) that only falls with the angle to the normal: f = exp of the integral of p d log cos(theta).

    The local exponent p > 0 is linear in log cos(theta) between `KNOTS_DEG`. p = 1 everywhere is the cosine law.

    Attributes:
        log_exponents: log p at the knots [7].

    Example:
        >>> hx.render(height, optics, raster, law=hx.MonotoneLaw(np.zeros(7)))
    """

    log_exponents: Any = eqx.field(converter=_number)

    def relative(self, cos_in: Any, cos_out: Any, along: Any) -> jax.Array:
        """Compute the density over that of the cosine law; arguments as those of `PowerLaw.relative`."""
        x, w = np.polynomial.legendre.leggauss(32)
        dtype = jnp.result_type(self.log_exponents, cos_out)
        cos, weight = (jnp.asarray(a, dtype) for a in (0.5 * (x + 1.0), 0.5 * w))
        return self._value(cos_out) / jnp.sum(2.0 * weight * cos * self._value(cos))

    def _value(self, cos: Any) -> jax.Array:
        """Compute f / cos(theta), 1 at the normal."""
        excess, total = jnp.exp(self.log_exponents) - 1.0, 0.0
        depth = -jnp.log(jnp.clip(cos, MIN_COS, 1.0))
        knots = -np.log(np.cos(np.radians(KNOTS_DEG)))
        for i, (start, end) in enumerate(zip(knots.tolist(), knots[1:].tolist(), strict=False)):
            t = jnp.clip((depth - start) / (end - start), 0.0, 1.0)
            total = total + (end - start) * t * (excess[i] + 0.5 * t * (excess[i + 1] - excess[i]))
        return jnp.exp(-total)

    def terms(self) -> tuple[Term, ...]:
        """Make the law of the tracer."""
        theta = np.radians(np.linspace(0.0, 90.0, 181))
        cos = np.maximum(np.cos(theta), 0.0)
        with jax.enable_x64(True):
            return (tabulated(theta, cos * np.asarray(self._value(jnp.asarray(cos)))),)


Law = PowerLaw | LobeLaw | RoughLaw | MonotoneLaw
"""Any law but the cosine law, which is None."""


def mean_over_aperture(law: Law, optics: Optics, height: Any, normal: Any) -> jax.Array:
    """Compute a law's value averaged over what each aperture subtends [detector, ...].

    The weights are those of the cosine law, so that n . Phi times this is the detection probability.

    Args:
        law: the law.
        optics: beam and apertures.
        height: of the points [...], um.
        normal: their unit normals [3, ...].
    """
    expand = (...,) + (None,) * height.ndim
    spot, facing = optics.spot(height), _cross(optics.axes)
    shift = jnp.asarray(optics.beam_shift)[None] if optics.beam_shifts is None else jnp.asarray(optics.beam_shifts)
    beam = jnp.stack([shift[:, 0], shift[:, 1], -jnp.ones_like(shift[:, 0])])
    beam = (beam / jnp.sqrt(jnp.sum(beam**2, 0)))[expand]  # [3, beam, ...]
    cos_in = -_dot(beam, normal)

    @jax.checkpoint  # as in the contour integral: what the transpose needs is evaluated anew
    def add(sums, at):
        place, share = at
        point = optics.center + jnp.einsum("kij,j->ki", jnp.asarray(optics.axes), place)
        way = [point[:, i][expand] - spot[i] for i in range(3)]
        square = _dot(way, way)
        out = [part / jnp.sqrt(square) for part in way]
        cos_out = _dot(out, normal)
        weight = share * _safe(cos_out) * jnp.abs(_dot(out, facing[expand])) / square
        value = law.relative(cos_in, cos_out, _dot(out, beam))
        return (sums[0] + weight * value, sums[1] + weight), None

    zero = jnp.zeros((optics.n_detectors, *height.shape), height.dtype)
    points = jnp.asarray(POINTS, height.dtype), jnp.asarray(WEIGHTS, height.dtype)
    (total, weight), _ = jax.lax.scan(add, (zero, zero), points)
    return total / weight


def by_law(law: Law | None, single: Any, optics: Optics, height: Any, normal: Any) -> Any:
    """Weight single scattering by the cosine law [detector, ...] by a law; None is the cosine law.

    Arguments as those of `mean_over_aperture`.
    """
    return single if law is None else single * mean_over_aperture(law, optics, height, normal)


def numbers_by_law(law: Law | None, *known: Any) -> np.ndarray:
    """Compute `by_law` of NumPy arrays, in float64."""
    with jax.enable_x64(True):
        return np.asarray(by_law(law, *known))


def level_ratio(law: Law, optics: Optics) -> np.ndarray:
    """Compute the signal of the level substrate by a law over that by the cosine law [detector]."""
    with jax.enable_x64(True):
        up = jnp.array([[0.0], [0.0], [1.0]])
        return np.asarray(mean_over_aperture(law, optics, jnp.zeros(1), up))[:, 0]


def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(axes: Any) -> jax.Array:
    """Compute the unit normals [3, detector] of the apertures' planes."""
    normal = jnp.cross(jnp.asarray(axes)[..., 0], jnp.asarray(axes)[..., 1])
    return (normal / jnp.sqrt(jnp.sum(normal**2, -1, keepdims=True))).T


def _missing(cos: Any) -> jax.Array:
    """Compute (1 - E) / (A r) of the single-scattering model's albedo E, by the paper's polynomial."""
    x = 1.0 - jnp.clip(cos, 0.0, 1.0)
    return _EON_A - x * (_FON[0] + x * (_FON[1] + x * (_FON[2] + x * _FON[3])))


def _angle_squared(cos: Any) -> jax.Array:
    """Compute arccos(cos)^2, which is smooth at 0, where arccos is not."""
    x = 1.0 - cos
    is_small = x < 1e-2
    series = x * (2.0 + x * (1.0 / 3.0 + x * (4.0 / 45.0 + x * (1.0 / 35.0 + x * 16.0 / 1575.0))))
    return jnp.where(is_small, series, jnp.arccos(jnp.clip(jnp.where(is_small, 0.0, cos), -1.0 + 1e-7, 1.0)) ** 2)


@cache
def _lobe_circles() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute what the norm of a lobe needs: its angles, the positive part of cos(theta) integrated over each circle
    about the axis, and the Chebyshev polynomials of the cosine of the axis' tilt that go through these tilts.

    On a circle at angle g, cos(theta) = p + q cos(a) with p = cos(tilt) cos(g), q = sin(tilt) sin(g); its positive part
    integrates to 2 (p t + q sin t), t = arccos(-p / q). Source: own derivation.

    Returns:
        Squared angles [angle]; integrals [tilt, angle]; coefficients of every polynomial [degree, tilt].
    """
    x, w = np.polynomial.legendre.leggauss(_NORM_ANGLES)
    g = 0.5 * np.pi * (x + 1.0)
    nodes = np.cos(np.pi * (np.arange(_NORM_DEGREE + 1) + 0.5) / (_NORM_DEGREE + 1))
    cos = 0.5 * (nodes[:, None] + 1.0)
    p, q = cos * np.cos(g), np.maximum(np.sqrt(1.0 - cos**2) * np.sin(g), 1e-300)
    t = np.arccos(np.clip(-p / q, -1.0, 1.0))
    circle = 2.0 * (p * t + q * np.sin(t)) * (0.5 * np.pi * w * np.sin(g))
    return g**2, circle, np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, _NORM_DEGREE))


def _lobe_norm(cos_in: Any, sigma: Any) -> jax.Array:
    """Compute the integral of cos(theta)+ exp(-g^2 / (2 sigma^2)) over all directions, the axis at arccos(cos_in)."""
    square, circle, through = (jnp.asarray(a, jnp.result_type(cos_in, sigma)) for a in _lobe_circles())
    terms, x = through @ (circle @ jnp.exp(-0.5 * square / sigma**2)), 2.0 * jnp.clip(cos_in, 0.0, 1.0) - 1.0
    last = before = jnp.zeros_like(x)
    for term in terms[:0:-1]:  # Clenshaw's sum of Chebyshev polynomials
        last, before = term + 2.0 * x * last - before, last
    return terms[0] + x * last - before
