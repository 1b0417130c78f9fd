"""What a search of aperture layouts minimises: heights' variance and masked area of samples, with its gradient (JAX).

Unknowns are polar angles, azimuths and logarithms of the areas of the apertures and of the working distance, or fewer
where a layout is tied: a symmetric pair has two apertures at mirrored azimuths. The total area is fixed: areas are
shares of it. Flow: `workflows/design` poses cases and ties, `planning/search` moves the unknowns.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from helio_jax.forward.compiling import compiled
from helio_jax.forward.layout import Layout
from helio_jax.forward.optics import Optics
from helio_jax.inverse.criterion import Case, expect_errors


class Ties(eqx.Module):
    """How the unknowns make a layout: base + matrix @ unknowns.

    Attributes:
        base: polar angles, azimuths [rad], logarithms of areas [3 * detector], and of the working distance over the
            stated one [1].
        matrix: derivative of these by the unknowns.
        total_area: of all apertures [um^2].
        working_distance: stated [um].
    """

    base: np.ndarray
    matrix: np.ndarray
    total_area: float
    working_distance: float

    def ellipses(self, unknowns: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """Compute the working distance [um] of a layout, and of its apertures centres [detector, 2] and semi-axes
        along and across the azimuth [detector, 2], um, and azimuths [detector], rad."""
        with jax.enable_x64(True):
            layout = _layout_of(*self.at(unknowns))
            shape = layout.center, layout.semi_axes, layout.azimuth
            center, semi_axes, azimuth = (np.asarray(a) for a in shape)
            return float(layout.working_distance), center, semi_axes, azimuth

    def at(self, unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the vector of the layout, and what it refers to."""
        return self.base + self.matrix @ unknowns, np.array([self.total_area, self.working_distance])


def _layout_of(vector: Any, scale: Any) -> Layout:
    """Make a layout of its vector, and total area [um^2] and stated working distance [um]."""
    polar, azimuth, log_area = vector[:-1].reshape(3, -1)
    return Layout(polar, azimuth, scale[0] * jax.nn.softmax(jnp.asarray(log_area)), scale[1] * jnp.exp(vector[-1]))


class Limits(eqx.Module):
    """What a layout must keep.

    Attributes:
        wall: least wall between apertures, the disc about the pinhole and the plate's edge [um].
        clearance: radius of that disc [um].
        plate_radius: of the plate, infinite where it has no edge [um].
        thickness: of the plate [um].
    """

    wall: Any
    clearance: Any
    plate_radius: Any
    thickness: Any


class Assessment(NamedTuple):
    """What a layout reaches on each sample [sample].

    Attributes:
        variance: mean variance of the heights that count [um^2].
        masked: share of the apertures that the sample masks.
        counts: per pixel, of all detectors together.
    """

    variance: Any
    masked: Any
    counts: Any


def assess(case: Case, optics: Optics, is_smooth: Any = False) -> Assessment:
    """Assess optics on one sample; `is_smooth` as in `expect_errors`.

    A height that no image determines counts with the sample's relief as its standard deviation, or a pixel's size where
    that is more: nobody knows less.
    """
    found = expect_errors(case, optics, is_smooth)
    own, most = found.variance.ravel(), jnp.maximum(case.relief, case.fixed.dx) ** 2
    limited = jnp.where(case.counted, own * most / (own + most), 0.0)
    return Assessment(jnp.sum(limited) / jnp.sum(case.counted), found.masked, found.counts)


class Goal(eqx.Module):
    """Samples that a layout is for.

    Attributes:
        cases: the samples, seen along the same beam.
        drops: depth of each one's substrate below the nominal spot [um].
    """

    cases: tuple[Case, ...]
    drops: tuple[Any, ...]

    @property
    def beam_shift(self) -> Any:
        """Of the beam [2]."""
        return self.cases[0].fixed.optics.beam_shift

    def assess_optics(self, optics: Optics) -> Assessment:
        """Assess optics, whose distance to the substrate is each sample's, as NumPy arrays [sample]."""
        optics = jax.tree.map(lambda a: np.asarray(a, np.float64), optics)
        at = [replace(optics, sample_distance=optics.working_distance + drop) for drop in self.drops]
        return self._assessed(at, 0.0, is_smooth=False)[0]

    def assess(self, ties: Ties, unknowns: np.ndarray) -> Assessment:
        """Assess a layout, as NumPy arrays [sample]."""
        return self._assessed(self._optics(ties, unknowns), 0.0, is_smooth=False)[0]

    def value_and_slope(self, ties: Ties, masked_weight: float, unknowns: np.ndarray) -> tuple[float, np.ndarray]:
        """Compute the mean over the samples of log(variance) + weight * masked share, smoothed, and its gradient."""
        at = self._optics(ties, unknowns)
        found, slopes = self._assessed(at, masked_weight, is_smooth=True)
        with jax.enable_x64(True):
            by_vector = [
                np.asarray(_pulled_back(*ties.at(unknowns), self.beam_shift, np.asarray(drop, float), slope))
                for drop, slope in zip(self.drops, slopes, strict=True)
            ]
        value = float(np.mean(np.log(found.variance) + masked_weight * found.masked))
        return value, ties.matrix.T @ np.mean(by_vector, 0)

    def _optics(self, ties: Ties, unknowns: np.ndarray) -> list[Optics]:
        with jax.enable_x64(True):
            at = [_optics_of(*ties.at(unknowns), self.beam_shift, np.asarray(d, float)) for d in self.drops]
            return jax.tree.map(np.asarray, at)

    def _assessed(
        self, optics: list[Optics], masked_weight: float, *, is_smooth: bool
    ) -> tuple[Assessment, list[Optics]]:
        """Assess optics, one for each sample; return the gradients of the goal by each one's numbers, too."""
        how = np.asarray(masked_weight, float), np.asarray(is_smooth)
        with jax.enable_x64(True):
            found = [
                jax.tree.map(np.asarray, _assessed_with_slope(o, case, *how))
                for case, o in zip(self.cases, optics, strict=True)
            ]
        parts = [assessment for (_, assessment), _ in found]
        return Assessment(*map(np.array, zip(*parts, strict=True))), [slope for _, slope in found]


@compiled
def _assessed_with_slope(optics: Optics, case: Case, masked_weight: Any, is_smooth: Any) -> Any:
    """Assess optics; return the goal, too, and its gradient. Everything goes through here: it compiles for long."""

    def goal(optics: Optics) -> tuple[Any, Assessment]:
        found = assess(case, optics, is_smooth)
        return jnp.log(found.variance) + masked_weight * found.masked, found

    return jax.value_and_grad(goal, has_aux=True)(optics)


@eqx.filter_jit
def _optics_of(vector: Any, scale: Any, beam_shift: Any, drop: Any) -> Optics:
    return _layout_of(vector, scale).optics(beam_shift, drop)


@eqx.filter_jit
def _pulled_back(vector: Any, scale: Any, beam_shift: Any, drop: Any, slope: Optics) -> Any:
    """Compute the gradient by the vector of a layout from that by its optics."""
    return jax.vjp(lambda v: _layout_of(v, scale).optics(beam_shift, drop), jnp.asarray(vector))[1](slope)[0]


def room_of(ties: Ties, unknowns: np.ndarray, beam_shift: Any, limits: Limits) -> np.ndarray:
    """Compute by how much a layout keeps every limit [limit], mm; negative: broken."""
    with jax.enable_x64(True):
        return np.asarray(_room(*ties.at(unknowns), beam_shift, limits))


def keeps_limits(ties: Ties, many: np.ndarray, beam_shift: Any, limits: Limits) -> np.ndarray:
    """Return which of many layouts [layout, unknown] keep every limit [layout]."""
    scale = ties.at(np.zeros(many.shape[1]))[1]
    with jax.enable_x64(True):
        return np.asarray(_rooms(ties.base + many @ ties.matrix.T, scale, beam_shift, limits)).min(1) >= 0.0


def room_slope_of(ties: Ties, unknowns: np.ndarray, beam_shift: Any, limits: Limits) -> np.ndarray:
    """Compute the derivative of `room_of` [limit, unknown]."""
    with jax.enable_x64(True):
        return np.asarray(_room_slope(*ties.at(unknowns), beam_shift, limits)) @ ties.matrix


@eqx.filter_jit
def _room(vector: Any, scale: Any, beam_shift: Any, limits: Limits) -> jax.Array:
    layout = _layout_of(vector, scale)
    to_edge = jnp.minimum(limits.plate_radius, 1e9) - layout.reach(limits.thickness)
    return 1e-3 * (jnp.concatenate([layout.gaps(beam_shift, limits.clearance), to_edge]) - limits.wall)


_room_slope = eqx.filter_jit(jax.jacfwd(_room))
_rooms = eqx.filter_jit(eqx.filter_vmap(_room, in_axes=(0, None, None, None)))
