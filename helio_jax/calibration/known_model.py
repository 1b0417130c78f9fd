"""Detection probability of a scan of a known object as a function of all its unknowns (JAX, differentiable).

The geometry is exact: closed-form first hits and horizons (`forward.known_shapes`). Multiple scattering is expanded to
first order about the unknowns at which it was computed (`Multiple`), for it is a tenth of the signal and costs most.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import gaussian_filter

from helio_jax.calibration.unknowns import OBJECT, PLATE
from helio_jax.forward.compiling import compiled
from helio_jax.forward.known_shapes import Ball, Flat, PlacedShape, Ramp, Shape
from helio_jax.forward.laws import PowerLaw
from helio_jax.forward.masking import masked_by_shape
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.radiosity import plan_radiosity, radiosity
from helio_jax.forward.render import Corrections, detection_probability
from helio_jax.forward.surface import unit_normal

SMOOTHING = 1.0
"""Standard deviation of the Gaussian that averages traced over predicted multiple scattering [pixels]: noise is 3.5
times smaller. The ratio changes at an object's foot, where the result is up to 1.1 % of the signal too large; averaged
over 2 pixels, 1.8 %."""
_LEAST_SHARE = 1e-15
"""Added to shares and squares whose logarithm or root is taken."""


class Multiple(eqx.Module):
    """Multiple scattering of an atom that its own pixel has scattered [detector, y, x], about unknowns `at`.

    `slope` [unknown, detector, y, x] belongs to the rows `free` of the unknowns.
    """

    value: Any
    slope: Any
    free: Any
    at: Any

    def of(self, unknowns: Any) -> Any:
        """Compute it at other unknowns, to first order."""
        return self.value + jnp.tensordot((unknowns - self.at)[self.free], self.slope, 1)

    def shifted(self, value: np.ndarray, at: np.ndarray) -> "Multiple":
        """Return that of a new value at other unknowns, with the same derivatives."""
        return Multiple(value, self.slope, self.free, at)


class ScanModel(eqx.Module):
    """What is known of a scan; `unknowns` [unknown] are changes of plate, apertures, and the numbers of the object."""

    optics: Optics
    raster: Raster
    kind: str = eqx.field(static=True)

    def moved_optics(self, unknowns: Any) -> Optics:
        """Compute the optics."""
        n = self.optics.n_detectors
        plate, aim = unknowns[: len(PLATE)], unknowns[len(PLATE) : len(PLATE) + 2 * n].reshape(2, n)
        return self.optics.moved(
            plate_shift=(plate[0], plate[1]),
            scale=1.0 + plate[2],
            rotation=plate[3],
            distance=plate[4],
            incidence=plate[5],
            polar=aim[0],
            azimuth=aim[1],
        )

    def object_of(self, unknowns: Any) -> dict[str, Any]:
        """Name the unknowns of the scan."""
        return dict(zip(OBJECT, unknowns[len(PLATE) + 2 * self.optics.n_detectors :], strict=True))

    def shape_of(self, unknowns: Any) -> PlacedShape:
        """Compute the shape in its place."""
        o = self.object_of(unknowns)
        azimuth, tilt = o["object azimuth"], jnp.stack([jnp.tan(o["tilt x"]), jnp.tan(o["tilt y"])])
        place = jnp.stack([o["object x"], o["object y"]])
        shape: Shape = Flat()
        if self.kind == "ball":
            shape = Ball(o["radius"], o["height"])
        elif self.kind in ("step", "wedge"):
            shape = Ramp(o["height"], jnp.cos(o["slope"]) / jnp.sin(o["slope"]))
            place = o["object x"] * jnp.stack([jnp.cos(azimuth), jnp.sin(azimuth)])
        return PlacedShape(shape, place, azimuth, tilt)

    def parts(self, unknowns: Any, multiple: Multiple, width: Any) -> tuple[jax.Array, jax.Array]:
        """Compute what each part of the scene would give in every pixel, and the logarithm of its share.

        Args:
            unknowns: of the scan [unknown].
            multiple: multiple scattering.
            width: of the outlines between the parts (`forward.known_shapes.Flat.parts`) [um].

        Returns:
            Detection probability per beam atom [part, detector, y, x]; logarithm of the share [part, y, x].
        """
        optics, shape, o = self.moved_optics(unknowns), self.shape_of(unknowns), self.object_of(unknowns)
        again = jnp.exp(o["log multiple scattering"]) * multiple.of(unknowns)
        values, shares = [], []
        for share, surface, is_object in shape.parts(self.raster, optics.beam_shift, width):
            albedo = jnp.exp(o["log albedo ratio"]) if is_object else 1.0
            corrections = Corrections(masked_by_shape(shape, optics, self.raster, surface, is_object), albedo * again)
            values.append(detection_probability(surface, optics, corrections, albedo, PowerLaw(o["exponent"])))
            shares.append(jnp.log(share + _LEAST_SHARE))
        return jnp.stack(values), jnp.stack(shares)

    def probability(self, unknowns: Any, multiple: Multiple) -> jax.Array:
        """Compute the detection probability per beam atom [detector, y, x]."""
        value, log_share = self.parts(unknowns, multiple, 0.0)
        return jnp.sum(jnp.exp(log_share)[:, None] * value, 0)

    def fitted(self, unknowns: Any, multiple: Multiple, width: Any, member: Any) -> tuple[jax.Array, jax.Array]:
        """Compute what is compared with the data: detection probability [detector, y, x], and the outline [y, x].

        The outline is a residual: its square is twice the negative logarithm of the likelihood that the pixels lie on
        the parts of which they are `member` [part, y, x].
        """
        value, log_share = self.parts(unknowns, multiple, width)
        misfit = jnp.maximum(-jnp.sum(member * log_share, 0), 0.0)
        return jnp.sum(member[:, None] * value, 0), jnp.sqrt(2.0 * misfit + _LEAST_SHARE)

    def scattered_again(self, unknowns: Any, plan: Any) -> jax.Array:
        """Compute the multiple scattering by radiosity [detector, y, x], without the albedo of the own pixel."""
        optics, shape, o = self.moved_optics(unknowns), self.shape_of(unknowns), self.object_of(unknowns)
        surface, is_object = shape.seen(self.raster, optics.beam_shift)
        normals = jnp.moveaxis(unit_normal(surface.slope_x, surface.slope_y, optics.beam_shift), 0, -1)
        albedo = jnp.where(is_object, jnp.exp(o["log albedo ratio"]), 1.0)
        return radiosity(surface.height, normals, optics, self.raster, plan, albedo)

    def thinned(self, stride: int) -> "ScanModel":
        """Keep every `stride`-th row and column."""
        return ScanModel(self.optics, self.raster.thinned(stride), self.kind)


class Seen(NamedTuple):
    """Where the pixels of a scan lie, NumPy: heights [y, x], um; which lie on the object [y, x]; from which pixels of
    the substrate the object hides part of an aperture [detector, y, x]; distance of the surface points from the axis or
    edge of the object [y, x], um."""

    height: np.ndarray
    is_object: np.ndarray
    is_masked: np.ndarray
    distance: np.ndarray


@compiled
def _geometry(model: ScanModel, unknowns: Any) -> Any:
    optics, shape = model.moved_optics(unknowns), model.shape_of(unknowns)
    surface, is_object = shape.seen(model.raster, optics.beam_shift)
    masked = masked_by_shape(shape, optics, model.raster, surface, is_object=False)
    is_masked = (jnp.sum(masked**2, 1) > 0.0) & ~is_object
    x, y = jnp.meshgrid(model.raster.x, model.raster.y)
    dx = x - surface.height * optics.beam_shift[0] - shape.place[0]
    dy = y - surface.height * optics.beam_shift[1] - shape.place[1]
    cos, sin = jnp.cos(shape.azimuth), jnp.sin(shape.azimuth)
    distance = jnp.hypot(dx, dy) if model.kind == "ball" else dx * cos + dy * sin
    return surface, is_object, is_masked, distance, optics


def see(model: ScanModel, unknowns: np.ndarray) -> Seen:
    """Compute where the pixels of a scan lie."""
    with jax.enable_x64(True):
        surface, *rest, _ = _geometry(model, jnp.asarray(unknowns))
        return Seen(np.asarray(surface.height), *map(np.asarray, rest))


_value = compiled(lambda model, *about: model.probability(*about))
_parts = compiled(lambda model, *about: model.parts(*about))
_fitted = compiled(lambda model, *about: model.fitted(*about))


@compiled
def _fitted_and_derivative(model: ScanModel, unknowns: Any, multiple: Multiple, width: Any, member: Any) -> Any:
    value, push = jax.linearize(lambda u: model.fitted(u, multiple, width, member), unknowns)
    ways = jnp.eye(len(unknowns), dtype=value[0].dtype)[multiple.free]
    return value, jax.vmap(push)(ways)  # at once: slices of apertures are evaluated anew in every push


def probability(model: ScanModel, unknowns: np.ndarray, multiple: Multiple) -> np.ndarray:
    """Compute the detection probability [detector, y, x], NumPy, float64."""
    with jax.enable_x64(True):
        return np.asarray(_value(model, jnp.asarray(unknowns), multiple))


def parts(model: ScanModel, unknowns: np.ndarray, multiple: Multiple, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute `ScanModel.parts`, NumPy, float64."""
    with jax.enable_x64(True):
        value, log_share = _parts(model, jnp.asarray(unknowns), multiple, jnp.asarray(width, float))
        return np.asarray(value), np.asarray(log_share)


def fitted(
    model: ScanModel, unknowns: np.ndarray, multiple: Multiple, width: float, member: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute `ScanModel.fitted`, NumPy, float64."""
    with jax.enable_x64(True):
        value, outline = _fitted(model, jnp.asarray(unknowns), multiple, jnp.asarray(width, float), member)
        return np.asarray(value), np.asarray(outline)


def fitted_and_derivative(
    model: ScanModel, unknowns: np.ndarray, multiple: Multiple, width: float, member: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Compute `ScanModel.fitted` and its derivatives [free unknown, ...], NumPy, float64."""
    with jax.enable_x64(True):
        about = model, jnp.asarray(unknowns), multiple, jnp.asarray(width, float), member
        value, slopes = _fitted_and_derivative(*about)
        return jax.tree.map(np.asarray, (value, slopes))


@compiled
def _scattered_again(model: ScanModel, unknowns: Any, plan: Any) -> Any:
    return model.scattered_again(unknowns, plan)


@compiled
def _again_derivative(model: ScanModel, unknowns: Any, plan: Any, free: Any) -> Any:
    ways = jnp.eye(len(unknowns))[free]
    return jax.lax.map(lambda way: jax.jvp(lambda u: model.scattered_again(u, plan), (unknowns,), (way,))[1], ways)


def no_multiple(model: ScanModel, unknowns: np.ndarray, free: np.ndarray) -> Multiple:
    """Make that of a scan without multiple scattering."""
    shape = (model.optics.n_detectors, *model.raster.shape)
    return Multiple(np.zeros(shape), np.zeros((len(free), *shape)), free, unknowns)


def expand_multiple(
    model: ScanModel,
    unknowns: np.ndarray,
    free: np.ndarray,
    substrate_um: float,
    pixels: int,
    traced: np.ndarray | None = None,
    plan: Any = None,
) -> Multiple:
    """Compute the multiple scattering and its derivatives at unknowns, by radiosity; `traced` replaces the value.

    Derivatives are those on a raster of about `pixels` along its longer side, each pixel's taken for its neighbours.
    `plan`: that of all pixels (`radiosity_plan`), if known.
    """
    stride = max(1, round(max(model.raster.shape) / pixels))
    if plan is None and (stride == 1 or traced is None):
        plan = radiosity_plan(model, unknowns, substrate_um)
    thin = model.thinned(stride)
    of_thin = plan if stride == 1 else radiosity_plan(thin, unknowns, substrate_um)
    with jax.enable_x64(True):
        slope = np.asarray(_again_derivative(thin, jnp.asarray(unknowns), of_thin, free))
    if traced is None:
        traced = radiosity_at(model, unknowns, plan)
    ny, nx = model.raster.shape
    nearest = [np.minimum((np.arange(n) + stride // 2) // stride, len(range(0, n, stride)) - 1) for n in (ny, nx)]
    return Multiple(traced, slope[:, :, nearest[0][:, None], nearest[1]], free, unknowns)


def radiosity_plan(model: ScanModel, unknowns: np.ndarray, substrate_um: float) -> Any:
    """Plan the radiosity of a scan, float64: what part of one pixel's atoms reach another."""
    with jax.enable_x64(True):
        surface, _, _, _, optics = _geometry(model, jnp.asarray(unknowns))
        optics = jax.tree.map(np.asarray, optics)
        normals = surface_normals(surface, optics)
        return plan_radiosity(np.asarray(surface.height), normals, optics, model.raster, substrate_um=substrate_um)


def radiosity_at(model: ScanModel, unknowns: np.ndarray, plan: Any) -> np.ndarray:
    """Compute the multiple scattering by radiosity [detector, y, x], NumPy, float64."""
    with jax.enable_x64(True):
        return np.asarray(_scattered_again(model, jnp.asarray(unknowns), plan))


def smoothed_by(traced: np.ndarray, predicted: np.ndarray, is_object: np.ndarray) -> np.ndarray:
    """Smooth the noise of traced multiple scattering: its ratio to a prediction without noise varies little.

    A regressor's noise makes its fitted factor too small: by half a standard deviation with 512 paths a pixel.

    Args:
        traced: multiple scattering [detector, y, x].
        predicted: the same by radiosity.
        is_object: which pixels lie on the object, across whose outline nothing is averaged [y, x].
    """
    out = traced.copy()
    for part in (is_object, ~is_object):
        counted, expected = (
            gaussian_filter(image * part, SMOOTHING, mode="constant", axes=(-2, -1)) for image in (traced, predicted)
        )
        known = np.broadcast_to(part, traced.shape) & (expected > 0.0)
        out[known] = predicted[known] * counted[known] / expected[known]
    return out


def surface_normals(surface: Any, optics: Optics) -> np.ndarray:
    """Compute the unit normals [y, x, 3] of a surface, NumPy."""
    return jax.tree.map(np.asarray, surface).normals(np.asarray(optics.beam_shift))
