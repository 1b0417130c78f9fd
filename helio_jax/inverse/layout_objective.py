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

from helio_jax.forward.layout import Layout
from helio_jax.forward.optics import Optics, cast
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

    base: Any
    matrix: Any
    total_area: Any
    working_distance: Any

    def layout(self, unknowns: Any) -> Layout:
        """Make the layout of unknowns."""
        everything = self.base + self.matrix @ unknowns
        polar, azimuth, log_area = everything[:-1].reshape(3, -1)
        return Layout(
            polar, azimuth, self.total_area * jax.nn.softmax(log_area), self.working_distance * jnp.exp(everything[-1])
        )

    def numbers(self, unknowns: np.ndarray) -> Layout:
        """Make the layout of unknowns as NumPy arrays."""
        with jax.enable_x64(True):
            return jax.tree.map(np.asarray, self.layout(jnp.asarray(unknowns)))


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


def assess(case: Case, optics: Optics) -> Assessment:
    """Assess optics on one sample.

    A height that no image determines counts with the sample's relief as its standard deviation: nobody knows less.
    """
    found = expect_errors(case, optics)
    own, most = found.variance.ravel(), jnp.maximum(case.relief, 1.0) ** 2
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
        return self.cases[0].fixed.beam_shift

    def assess_optics(self, optics: Optics) -> Assessment:
        """Assess optics, whose distance to the substrate is each sample's, as NumPy arrays [sample]."""
        with jax.enable_x64(True):
            at = [replace(optics, sample_distance=optics.working_distance + drop) for drop in self.drops]
            return _stacked([_assessed(case, cast(o, jnp.float64)) for case, o in zip(self.cases, at, strict=True)])

    def assess(self, ties: Ties, unknowns: np.ndarray) -> Assessment:
        """Assess a layout, as NumPy arrays [sample]."""
        with jax.enable_x64(True):
            pairs = zip(self.cases, self.drops, strict=True)
            return _stacked([_layout_assessed(jnp.asarray(unknowns), ties, *pair) for pair in pairs])

    def value_and_slope(self, ties: Ties, masked_weight: float, unknowns: np.ndarray) -> tuple[float, np.ndarray]:
        """Compute the mean over the samples of log(variance) + weight * masked share, and its gradient [unknown]."""
        with jax.enable_x64(True):
            at, weight = jnp.asarray(unknowns), jnp.asarray(masked_weight, jnp.float64)
            found = [_goal(at, ties, c, d, weight) for c, d in zip(self.cases, self.drops, strict=True)]
            return float(np.mean([v for v, _ in found])), np.mean([np.asarray(slope) for _, slope in found], 0)


def _stacked(parts: list[Assessment]) -> Assessment:
    return Assessment(*(np.array([float(v) for v in values]) for values in zip(*parts, strict=True)))


_assessed = eqx.filter_jit(assess)


@eqx.filter_jit
def _layout_assessed(unknowns: Any, ties: Ties, case: Case, drop: Any) -> Assessment:
    return assess(case, ties.layout(unknowns).optics(case.fixed.beam_shift, drop))


@eqx.filter_jit
@eqx.filter_value_and_grad
def _goal(unknowns: Any, ties: Ties, case: Case, drop: Any, masked_weight: Any) -> Any:
    found = assess(case, ties.layout(unknowns).optics(case.fixed.beam_shift, drop))
    return jnp.log(found.variance) + masked_weight * found.masked


def room_of(ties: Ties, unknowns: np.ndarray, beam_shift: Any, limits: Limits) -> np.ndarray:
    """Compute by how much a layout keeps every limit [limit], mm; negative: broken."""
    with jax.enable_x64(True):
        return np.asarray(_room(jnp.asarray(unknowns), ties, jnp.asarray(beam_shift), limits))


def room_slope_of(ties: Ties, unknowns: np.ndarray, beam_shift: Any, limits: Limits) -> np.ndarray:
    """Compute the derivative of `room_of` [limit, unknown]."""
    with jax.enable_x64(True):
        return np.asarray(_room_slope(jnp.asarray(unknowns), ties, jnp.asarray(beam_shift), limits))


@eqx.filter_jit
def _room(unknowns: Any, ties: Ties, beam_shift: Any, limits: Limits) -> jax.Array:
    layout = ties.layout(unknowns)
    to_edge = jnp.minimum(limits.plate_radius, 1e9) - layout.reach(limits.thickness)
    return 1e-3 * (jnp.concatenate([layout.gaps(beam_shift, limits.clearance), to_edge]) - limits.wall)


_room_slope = eqx.filter_jit(jax.jacfwd(_room))
