"""The geometry of one scan as a pytree: beam, pinhole plate, apertures, raster. Every number is a traced leaf.

Lab frame (docs/conventions.md): z up from sample to plate, origin where the beam axis is at the design working distance
below the plate. In a raster scan the lab position of the illuminated point depends on its height alone. An aperture is
an ellipse anywhere in space, so that the plate may be tilted. Precision: NumPy numbers are float64; JAX arrays keep
their own (`in_own_precision`). Knows no surface, count or file.
"""

from collections.abc import Callable
from functools import partial, wraps
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from helio_jax.arrays import pitch
from helio_jax.instrument import Instrument
from helio_jax.micrograph import MicrographStack

P = ParamSpec("P")
R = TypeVar("R")


def in_own_precision(function: Callable[P, R]) -> Callable[P, R]:
    """Run a function in the precision of its JAX arrays, or in float64 where all of its numbers are NumPy or Python.

    JAX rounds NumPy numbers to float32 unless float64 is enabled; the program never enables it globally.
    """

    @wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> R:
        arrays = [leaf for leaf in jax.tree.leaves((args, kwargs)) if isinstance(leaf, jax.Array)]
        floats = [a.dtype for a in arrays if jnp.issubdtype(a.dtype, jnp.floating)]
        with jax.enable_x64(not floats or any(dtype == np.float64 for dtype in floats)):
            return function(*args, **kwargs)

    return wrapped


def cast(tree: Any, dtype: Any) -> Any:
    """Convert a tree's fractional numbers to JAX arrays of one precision, its integers to JAX arrays."""
    return jax.tree.map(lambda a: jnp.asarray(a, None if jnp.result_type(a).kind in "iub" else dtype), tree)


class Raster(eqx.Module):
    """Beam positions of a scan: where the beam axis meets the substrate's plane z = 0, in the sample frame [um].

    Attributes:
        x: of the columns, increasing, equally spaced [x].
        y: of the rows [y].

    Example:
        >>> hx.Raster.of(stack)
    """

    x: Float[Any, " x"]
    y: Float[Any, " y"]

    @classmethod
    def of(cls, scan: Any) -> "Raster":
        """Take the raster of a `MicrographStack` (x, y) or a `Reconstruction` (raster_x, raster_y)."""
        if isinstance(scan, MicrographStack):
            return cls(scan.x, scan.y)
        return cls(scan.raster_x, scan.raster_y)

    @classmethod
    def regular(cls, shape: tuple[int, int], dx: float, dy: float | None = None) -> "Raster":
        """Make a raster (rows, columns) of pitch dx, dy [um], centred on the origin."""
        steps = (dx if dy is None else dy, dx)
        y, x = (step * (np.arange(n) - 0.5 * (n - 1)) for step, n in zip(steps, shape, strict=True))
        return cls(x, y)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.y.shape[0], self.x.shape[0]

    @property
    def dx(self) -> Any:
        """Pitch of the columns [um]."""
        return _step(self.x)

    @property
    def dy(self) -> Any:
        """Pitch of the rows [um]."""
        return _step(self.y)

    def centred_positions(self) -> np.ndarray:
        """Compute the positions (x, y) relative to the middle of the raster [2, y, x], um; NumPy axes only."""
        centred = Raster.regular(self.shape, self.dx, self.dy)
        return np.stack(np.meshgrid(centred.x, centred.y))

    def thinned(self, stride: int) -> "Raster":
        """Keep every `stride`-th row and column."""
        return Raster(self.x[::stride], self.y[::stride])


def _step(axis: Any) -> Any:
    return pitch(axis) if isinstance(axis, np.ndarray) else (axis[-1] - axis[0]) / max(axis.shape[0] - 1, 1)


class Optics(eqx.Module):
    """Beam and detector apertures of one scan; lengths in um, lab frame.

    Attributes:
        center: centre of each aperture.
        axes: its two conjugate semi-axes as columns: the rim is center + axes @ (cos s, sin s), counter-clockwise seen
            from above for s from 0 to 2 pi.
        beam_shift: tan t (cos phi, sin phi) of a beam with incidence t and azimuth phi: how far the beam axis moves in
            (x, y) per um of depth.
        working_distance: design working distance W: height of the plate above the lab frame's origin.
        sample_distance: distance D from the plate to the substrate.
        beam_shifts: the same of the beam of every image, where a stack joins scans of several beams; then `beam_shift`
            is that along which the raster sees the sample (0: straight down). None: one beam.

    Example:
        >>> hx.Optics.of(hx.load_instrument("bshem_wd4"))
    """

    center: Float[Any, "detector 3"]
    axes: Float[Any, "detector 3 2"]
    beam_shift: Float[Any, "2"]
    working_distance: Float[Any, ""]
    sample_distance: Float[Any, ""]
    beam_shifts: Float[Any, "detector 2"] | None = None

    @classmethod
    def of(cls, instrument: Instrument) -> "Optics":
        """Convert an instrument (NumPy float64 leaves).

        Raises:
            SceneError: a detector is at infinity, or the plate is a mesh.
        """
        apertures, w = instrument.apertures(), instrument.working_distance
        center = np.array([[*a.center, w] for a in apertures])
        axes = np.array([[*ellipse_axes(a.semi_axes, a.rotation), [0.0, 0.0]] for a in apertures])
        shifts = instrument.beam_shifts if instrument.has_several_beams else None
        distance = np.array(instrument.sample_distance)
        return cls(center, axes, np.array(instrument.beam_shift), np.array(w), distance, shifts)

    @property
    def n_detectors(self) -> int:
        """Number of apertures."""
        return self.center.shape[0]

    @property
    def drop(self) -> Any:
        """Depth of the substrate below the lab frame's origin: D - W [um]."""
        return self.sample_distance - self.working_distance

    def spot(self, height: Any) -> tuple[Any, Any, Any]:
        """Compute the lab position (x, y, z) of the illuminated point of a given height above the substrate [um].

        With several beams x and y are those in the scan of every image [detector, ...].
        """
        z = height - self.drop
        if self.beam_shifts is None:
            return -z * self.beam_shift[0], -z * self.beam_shift[1], z
        x, y = (self.beam_shifts[:, i].reshape(-1, *(1,) * z.ndim) for i in (0, 1))
        return -z * x, -z * y, z

    def of_raster(self) -> "Optics":
        """Return optics of one beam, that of the raster: each aperture as seen from the substrate by its own beam.

        Seen from a height h, the apertures of another beam stand h times the difference of the beam shifts elsewhere.
        """
        if self.beam_shifts is None:
            return self
        aside = self.drop * (self.beam_shift - self.beam_shifts)
        center = jnp.asarray(self.center).at[:, :2].add(aside)
        return Optics(center, self.axes, self.beam_shift, self.working_distance, self.sample_distance)

    def rims(self, n_points: int) -> tuple[Any, Any]:
        """Compute rim points and tangents (derivatives by the parameter s) [n_points, 3, detector]."""
        s = 2.0 * np.pi * np.arange(n_points) / n_points
        cos, sin = (f(s)[:, None, None].astype(self.axes.dtype) for f in (np.cos, np.sin))
        first, second = self.axes[..., 0].T, self.axes[..., 1].T
        return self.center.T + cos * first + sin * second, cos * second - sin * first

    @in_own_precision
    def moved(
        self,
        *,
        plate_shift: Any = (0.0, 0.0),
        distance: Any = 0.0,
        scale: Any = 1.0,
        rotation: Any = 0.0,
        tilt: Any = (0.0, 0.0),
        incidence: Any = 0.0,
        beam_azimuth: Any = 0.0,
        polar: Any = 0.0,
        azimuth: Any = 0.0,
        size: Any = 1.0,
    ) -> "Optics":
        """Move plate, beam and single apertures; differentiable in every argument.

        The order: single apertures (size, polar, azimuth), then the plate as one rigid piece (scale, rotation, tilt,
        shift), then the distance, then the beam. The pivot of polar angles, rotations and tilts is the lab frame's
        origin, the nominal spot; scaling leaves the plate's height and the point straight above the origin in place.

        Args:
            plate_shift: shift of the plate in its plane, against the beam (x, y) [um].
            distance: change of the distance from plate to substrate, the spot moving along the beam [um].
            scale: factor of all lengths in the plate's plane.
            rotation: of the plate about its normal, counter-clockwise seen from above [rad].
            tilt: of the plate about the x and the y axis [rad].
            incidence: change of the beam's incidence angle; a beam along the normal tips towards its azimuth 0 [rad].
            beam_azimuth: change of the beam's azimuth [rad].
            polar: change of the angle between each aperture's centre and the plate normal [rad], scalar or [detector].
            azimuth: change of each aperture's azimuth, the ellipse turning with it [rad], scalar or [detector].
            size: factor of each aperture's axes, scalar or [detector].
        """
        k = self.n_detectors
        polar, azimuth, size = (jnp.broadcast_to(jnp.asarray(v), (k,)) for v in (polar, azimuth, size))
        center, axes = jnp.asarray(self.center), jnp.asarray(self.axes) * size[:, None, None]
        radius = safe_norm(center[:, 0], center[:, 1])
        outward = center[:, :2] / jnp.maximum(radius, 1e-9)[:, None]
        reach = center[:, 2] * jnp.tan(jnp.arctan2(radius, center[:, 2]) + polar) - radius
        center = center.at[:, :2].add(reach[:, None] * outward)
        turn = rotation_matrix(jnp.zeros(()), jnp.zeros(()), azimuth)
        center, axes = jnp.einsum("kij,kj->ki", turn, center), jnp.einsum("kij,kjn->kin", turn, axes)
        stretch = jnp.stack([jnp.asarray(scale)] * 2 + [jnp.ones_like(jnp.asarray(scale))])
        rigid = rotation_matrix(jnp.asarray(tilt[0]), jnp.asarray(tilt[1]), jnp.asarray(rotation)) * stretch
        # tilted about its point straight above the origin, so that tilt alone leaves the distance as it is
        pivot = jnp.array([0.0, 0.0, 1.0], center.dtype) * self.working_distance
        center, axes = (center - pivot) @ rigid.T + pivot, jnp.einsum("ij,kjn->kin", rigid, axes)
        center = center.at[:, :2].add(jnp.stack([jnp.asarray(v) for v in plate_shift]))
        turned = partial(_turned_beam, incidence=incidence, azimuth=beam_azimuth)
        shift, shifts = jnp.asarray(self.beam_shift), self.beam_shifts
        return Optics(
            center,
            axes,
            turned(shift) if shifts is None else shift,
            jnp.asarray(self.working_distance),
            self.sample_distance + jnp.asarray(distance),
            None if shifts is None else jax.vmap(turned)(jnp.asarray(shifts)),
        )


def _turned_beam(shift: Any, incidence: Any, azimuth: Any) -> Any:
    """Compute the beam shift after changes of incidence and azimuth, differentiable at normal incidence, too."""
    tan, more = safe_norm(shift[0], shift[1]), jnp.tan(incidence)
    along = jnp.where(tan > 0.0, shift / jnp.where(tan > 0.0, tan, 1.0), jnp.array([1.0, 0.0], shift.dtype))
    moved = (shift + more * along) / (1.0 - tan * more)  # the tangent of a sum; keeps d moved / d shift where tan = 0
    cos, sin = jnp.cos(azimuth), jnp.sin(azimuth)
    return jnp.stack([cos * moved[0] - sin * moved[1], sin * moved[0] + cos * moved[1]])


def safe_norm(x: Any, y: Any) -> Any:
    """Compute hypot(x, y), with derivative 0 instead of NaN at the origin."""
    square = x * x + y * y
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)


def rotation_matrix(about_x: Any, about_y: Any, about_z: Any) -> Any:
    """Compute the rotation about z, then y, then x [..., 3, 3]; angles in rad, of one common shape by broadcasting."""
    a, b, c = jnp.broadcast_arrays(about_x, about_y, about_z)
    (ca, cb, cc), (sa, sb, sc) = (tuple(f(v) for v in (a, b, c)) for f in (jnp.cos, jnp.sin))
    rows = (
        (cb * cc, -cb * sc, sb),
        (ca * sc + sa * sb * cc, ca * cc - sa * sb * sc, -sa * cb),
        (sa * sc - ca * sb * cc, sa * cc + ca * sb * sc, ca * cb),
    )
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


def ellipse_axes(semi_axes: tuple[float, float], rotation: float) -> np.ndarray:
    """Compute the semi-axes of an ellipse as columns [2, 2]: unit circle -> ellipse."""
    cos, sin = np.cos(rotation), np.sin(rotation)
    return np.array([[cos, -sin], [sin, cos]]) * semi_axes
