"""Layouts of apertures: polar angle, azimuth and area of each, as optics; distances between them (JAX, differentiable).

Each aperture is the section of the plate with a round channel that points at the nominal spot: an ellipse with the
semi-axes r across and r / cos(polar) along its azimuth, r being the channel's radius. So it can be drilled.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from helio_jax.forward.optics import Optics

N_WAYS = 360
"""Directions in which the distance of two ellipses is tried; it is known to 1 / 2 (pi / N_WAYS)^2 of itself."""


class Layout(eqx.Module):
    """Apertures of a plate, seen from the nominal spot.

    Attributes:
        polar: angle between the direction of each aperture's centre and the plate normal [rad].
        azimuth: counter-clockwise from +x seen from above [rad].
        area: of the ellipse on the plate [um^2].
        working_distance: of the nominal spot below the plate [um].
    """

    polar: Float[Any, " detector"]
    azimuth: Float[Any, " detector"]
    area: Float[Any, " detector"]
    working_distance: Float[Any, ""]

    @property
    def semi_axes(self) -> Any:
        """Of each ellipse, along and across its azimuth [detector, 2], um; the latter is the radius of its channel."""
        across = jnp.sqrt(self.area * jnp.cos(self.polar) / np.pi)
        return jnp.stack([across / jnp.cos(self.polar), across], -1)

    @property
    def center(self) -> Any:
        """Centres on the plate, from the point above the nominal spot [detector, 2], um."""
        reach = self.working_distance * jnp.tan(self.polar)
        return jnp.stack([reach * jnp.cos(self.azimuth), reach * jnp.sin(self.azimuth)], -1)

    def axes(self) -> Any:
        """Compute the semi-axes as columns: along the azimuth, across it [detector, 2, 2], um."""
        cos, sin, (along, across) = jnp.cos(self.azimuth), jnp.sin(self.azimuth), self.semi_axes.T
        return jnp.stack([jnp.stack([along * cos, -across * sin], -1), jnp.stack([along * sin, across * cos], -1)], -2)

    def optics(self, beam_shift: Any, drop: Any) -> Optics:
        """Make the optics.

        Args:
            beam_shift: of the beam (`Optics.beam_shift`).
            drop: depth of the substrate below the nominal spot [um].
        """
        w, k = jnp.asarray(self.working_distance), len(self.polar)
        center = jnp.concatenate([self.center, jnp.broadcast_to(w, (k, 1))], -1)
        axes = jnp.concatenate([self.axes(), jnp.zeros((k, 1, 2))], 1)
        return Optics(center, axes, jnp.asarray(beam_shift), w, w + drop)

    def gaps(self, beam_shift: Any, clearance: Any) -> jax.Array:
        """Compute the walls between apertures, and between each one and the disc about the pinhole [pair], um.

        Negative where they overlap. Channels through a thick plate diverge upwards, so that their walls are thinnest
        on the underside.

        Args:
            beam_shift: of the beam, which sets the pinhole's place.
            clearance: radius of the disc about the pinhole that is kept free [um].
        """
        pinhole = -self.working_distance * jnp.asarray(beam_shift)
        center = jnp.concatenate([self.center, pinhole[None]])
        axes = jnp.concatenate([self.axes(), clearance * jnp.eye(2)[None]])
        first, second = np.triu_indices(len(center), 1)
        return _distance(center[second] - center[first], axes[first], axes[second])

    def reach(self, thickness: Any) -> jax.Array:
        """Compute how far each channel reaches from the middle of the plate, at the upper side [detector], um."""
        far = self.working_distance * jnp.tan(self.polar) * (1.0 + thickness / self.working_distance)
        return far + self.semi_axes[:, 0]


def _distance(apart: jax.Array, first: jax.Array, second: jax.Array) -> jax.Array:
    """Compute the distances of ellipses [pair]; negative: how far they overlap.

    The distance of two convex sets is the widest strip between them: the maximum over unit vectors e of
    e . (c2 - c1) - h1(e) - h2(e), where h(e) = |axes' e| is the ellipse's support function.

    Args:
        apart: from centre to centre [pair, 2], um.
        first, second: semi-axes as columns [pair, 2, 2], um.

    Source: Boyd and Vandenberghe, Convex Optimization (2004), sec. 8.1.1.
    """
    turn = 2.0 * np.pi * np.arange(N_WAYS) / N_WAYS
    way = np.stack([np.cos(turn), np.sin(turn)])

    def support(axes: jax.Array) -> jax.Array:
        return jnp.sqrt(jnp.sum(jnp.einsum("pij,iw->pjw", axes, way) ** 2, 1))

    return jnp.max(apart @ way - support(first) - support(second), axis=1)
