"""What a scan of a ball on a flat shows whatever the scattering law: masks, outline, smooth brightness (JAX).

On the substrate a detector reads its level times the visible share of its aperture, and what the ball scatters there,
which falls with the distance from it. On the ball it reads a smooth function of the normal. Levels, brightness and
offset are free numbers, so that only the outlines of the masks and of the ball tell anything of the geometry.

Source of the brightness as spherical harmonics of the normal: Basri and Jacobs, IEEE PAMI 25 (2003) 218.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from helio_jax.calibration.known_model import ScanModel
from helio_jax.forward.compiling import compiled
from helio_jax.forward.masking import masked_by_shape
from helio_jax.forward.optics import Optics
from helio_jax.forward.render import Corrections, detection_probability
from helio_jax.forward.surface import unit_normal

HARMONICS = 5
"""Degree of the brightness of the ball in the components of its normal."""
_POWERS = tuple(
    (a, b, c) for c in (0, 1) for a in range(HARMONICS + 1) for b in range(HARMONICS + 1) if a + b + c <= HARMONICS
)
N_LEVEL, N_SCATTERED, N_BRIGHT = 3, 9, len(_POWERS)
"""Columns of the level on the substrate (1, x, y), of what the ball scatters there, and of the ball's brightness."""
N_COLUMNS = N_LEVEL + N_SCATTERED + N_BRIGHT
CLOSE = 0.15
"""Distance [radii of the foot] over which the nearest part of the light that the ball scatters falls. Without it that
light was taken for a mask where an aperture stands so steep that it has hardly any (polar angles 5 degrees off)."""
_NEAREST = 0.7
"""Radii of the foot within which the light that the ball scatters is taken as constant."""
_LEAST = 1e-15


class MaskModel(eqx.Module):
    """The scan of a ball on a flat; unknowns are those of `ScanModel`."""

    scan: ScanModel

    def columns(self, unknowns: Any, width: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Compute of what a detector's reading consists, but for the offset.

        Args:
            unknowns: of the scan [unknown].
            width: of the outline between ball and substrate, the scale of a logistic function [um].

        Returns:
            Visible share of every aperture from the substrate [detector, y, x]; the columns, alike for all detectors,
            those of the level for an aperture that is wholly visible [column, y, x]; logarithm of the shares that ball
            and substrate take of every pixel [2, y, x].
        """
        scan = self.scan
        optics, shape = scan.moved_optics(unknowns), scan.shape_of(unknowns)
        (share, ball, _), (rest, flat, _) = shape.parts(scan.raster, optics.beam_shift, width)
        masked = masked_by_shape(shape, optics, scan.raster, flat, is_object=False)
        nothing = jnp.zeros((optics.n_detectors, *share.shape), share.dtype)
        seen, whole = (
            detection_probability(flat, optics, Corrections(m, nothing)) for m in (masked, jnp.zeros_like(masked))
        )
        x, y = jnp.meshgrid(scan.raster.x, scan.raster.y)
        u, v = (2.0 * (a - jnp.mean(a)) / jnp.ptp(a) for a in (x, y))
        own = scan.object_of(unknowns)
        foot = jnp.sqrt(own["height"] * (2.0 * own["radius"] - own["height"]))
        dx, dy = (
            (a - flat.height * s - p) / foot for a, s, p in zip((x, y), optics.beam_shift, shape.place, strict=True)
        )
        square = jnp.maximum(dx**2 + dy**2, _NEAREST**2)
        around = jnp.stack([jnp.ones_like(dx), dx / jnp.sqrt(square), dy / jnp.sqrt(square)])
        n = unit_normal(ball.slope_x, ball.slope_y, optics.beam_shift)
        bright = jnp.stack([n[0] ** a * n[1] ** b * n[2] ** c for a, b, c in _POWERS])
        level = jnp.stack([jnp.ones_like(u), u, v])
        close = jnp.exp((1.0 - jnp.sqrt(square)) / CLOSE)
        every = jnp.concatenate([level, around / square, around / square**2, around * close, bright])
        return seen / whole, every, jnp.log(jnp.stack([share, rest]) + _LEAST)

    def reading(self, unknowns: Any, width: Any, member: Any, linear: Any) -> tuple[jax.Array, jax.Array]:
        """Compute the readings without offset [detector, y, x], and the residuals of the outline [y, x].

        Args:
            unknowns, width: as for `columns`.
            member: probability that a pixel lies on ball and substrate [2, y, x].
            linear: amplitudes of the columns [detector, column].
        """
        visible, every, log_share = self.columns(unknowns, width)
        ball, flat = parts_of(visible, every, linear)
        misfit = jnp.maximum(-jnp.sum(member * log_share, 0), 0.0)
        return member[0] * ball + member[1] * flat, jnp.sqrt(2.0 * misfit + _LEAST)


def parts_of(visible: Any, every: Any, linear: Any) -> tuple[Any, Any]:
    """Compute what ball and substrate would give in every pixel, without offset [detector, y, x]; NumPy or JAX.

    Args:
        visible, every: of `MaskModel.columns`.
        linear: amplitudes of the columns [detector, column].
    """

    def of(columns: slice) -> Any:
        part = every[columns]
        return (linear[:, columns] @ part.reshape(part.shape[0], -1)).reshape(-1, *part.shape[1:])

    first = N_LEVEL + N_SCATTERED
    return of(slice(first, None)), of(slice(N_LEVEL)) * visible + of(slice(N_LEVEL, first))


def directions_of(optics: Optics) -> jax.Array:
    """Compute polar angle and azimuth of every aperture's centre as the spot sees it [detector, 2], rad.

    The spot is where the beam meets the substrate; the polar angle is that to the plate's normal.
    """
    spot = jnp.stack(optics.spot(jnp.zeros(()))[:2])
    at = jnp.asarray(optics.center)[:, :2] - spot
    polar = jnp.arctan2(jnp.hypot(at[:, 0], at[:, 1]), optics.sample_distance)
    return jnp.stack([polar, jnp.arctan2(at[:, 1], at[:, 0])], 1)


_columns = compiled(lambda model, *about: model.columns(*about))


@compiled
def _derivative(model: MaskModel, unknowns: Any, width: Any, member: Any, linear: Any, free: Any) -> Any:
    _, push = jax.linearize(lambda u: model.reading(u, width, member, linear), unknowns)
    return jax.vmap(push)(jnp.eye(len(unknowns), dtype=unknowns.dtype)[free])


@compiled
def _directions(model: MaskModel, unknowns: Any) -> Any:
    def of(u: Any) -> Any:
        return directions_of(model.scan.moved_optics(u))

    return of(unknowns), jax.jacfwd(of)(unknowns)


def columns(model: MaskModel, unknowns: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute `MaskModel.columns`, NumPy, float64."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, _columns(model, jnp.asarray(unknowns), jnp.asarray(width, float)))


def reading_derivative(
    model: MaskModel, unknowns: np.ndarray, width: float, member: np.ndarray, linear: np.ndarray, free: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the derivatives of `MaskModel.reading` by some unknowns [free unknown, ...], NumPy, float64."""
    with jax.enable_x64(True):
        about = jnp.asarray(unknowns), jnp.asarray(width, float), jnp.asarray(member), jnp.asarray(linear)
        return jax.tree.map(np.asarray, _derivative(model, *about, free))


def directions(model: MaskModel, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute `directions_of` at unknowns and the derivatives [detector, 2, unknown], NumPy, float64."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, _directions(model, jnp.asarray(unknowns)))
