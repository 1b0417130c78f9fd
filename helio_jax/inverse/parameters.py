"""The unknowns of the fit that are not the surface, their priors, and what they stand for (JAX, differentiable, pure).

All are counted in prior standard deviations from their prior means.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.fft import idctn

from helio_jax.forward.compiling import compiled
from helio_jax.forward.laws import Law
from helio_jax.forward.optics import Optics, in_own_precision
from helio_jax.forward.readout import Readout


class Parameters(eqx.Module):
    """Unknowns that are not the surface, in prior standard deviations; those that are known have no entries.

    Attributes:
        log_gain, offset, log_multiple: gain, offset, scale of the multiple scattering [detector].
        occluded: where the side of the sample that the beam does not see stands [].
        surroundings: how the sample goes on beyond a free border [1].
        albedo: cosine modes of the smooth albedo [mode, mode].
        drift: slow drift [detector, mode].
        discrepancy: of what the model lacks in each detector's image, cosine modes [detector, mode, mode].
        lines: offsets of the scan lines [detector, line].
        law: numbers of the scattering law [number].
        distance: of the sample from the plate [1].
        tilt: of the substrate [2: x, y].
        aim: polar angle and azimuth of the apertures [detector, 2].
        patch: log albedo of the patches [patch].
    """

    log_gain: Any
    offset: Any
    log_multiple: Any
    occluded: Any
    surroundings: Any
    albedo: Any
    drift: Any
    discrepancy: Any
    lines: Any
    law: Any
    distance: Any
    tilt: Any
    aim: Any
    patch: Any

    def free(self) -> tuple[str, ...]:
        """Names of the unknowns that have entries, without the scan lines.

        A line has so many pixels that its offset depends on its own data alone.
        """
        return tuple(name for name in NAMES if name != "lines" and getattr(self, name).size)

    def replaced(self, **values: Any) -> "Parameters":
        """Copy with other values."""
        return Parameters(**{name: values.get(name, getattr(self, name)) for name in NAMES})


NAMES = tuple(Parameters.__dataclass_fields__)
"""Names of the parameters, in array order."""


HELD = 1e-4
"""What is held in a fit has this share of its prior standard deviation."""


class LawPrior(eqx.Module):
    """What is known of the numbers of a scattering law: means and standard deviations, each in the form of a law."""

    mean: Law
    std: Law

    def at(self, whitened: jax.Array) -> Law:
        """Return the law of numbers in standard deviations from their means [number]."""
        mean, restore = ravel_pytree(self.mean)
        return restore(mean + ravel_pytree(self.std)[0] * whitened)


class Priors(eqx.Module):
    """Prior standard deviations: relative gain; offset [detector]; scale of multiple scattering; albedo; drift,
    discrepancy and line offsets [detector]; tilt [rad]; log albedo of patches. Of the geometry, a factor of the prior
    covariance of what is unknown of distance [um] and directions [rad] (`GeometryPrior`) [parameter, parameter]. Of the
    law, None where it is the cosine law."""

    gain: Any
    offset: Any
    multiple: Any
    albedo: Any
    drift: Any
    discrepancy: Any
    lines: Any
    law: LawPrior | None
    geometry: Any
    tilt: Any
    patch: Any


def smooth_images(modes: jax.Array | np.ndarray, shape: tuple[int, ...], std: Any) -> jax.Array:
    """Compute images [image, y, x] of cosine modes [image, mode, mode], as much in every octave of wavelengths.

    The constant mode is left to the offsets. Averaged over an image, the variance of a pixel is the square of `std`
    [image] where the modes are standard normal.
    """
    scale = jnp.asarray(std)[:, None, None] * np.sqrt(shape[0] * shape[1]) * mode_weights(modes.shape[-1])
    return _from_spectrum(modes * scale, shape)


def mode_weights(n: int) -> np.ndarray:
    """Compute the standard deviations of the cosine modes of `smooth_images`, of unit sum of squares [mode, mode]."""
    rank = np.hypot(*np.indices((n, n)))
    rank[0, 0] = np.inf
    return 1.0 / rank / np.sqrt(np.sum(rank**-2.0))


def smooth_albedo(modes: jax.Array, shape: tuple[int, ...], std: Any) -> jax.Array:
    """Compute the smooth albedo exp(sum of cosine modes); the constant mode is left to the gains. No modes: 1."""
    n = modes.shape[0]
    rank = jnp.hypot(*jnp.meshgrid(jnp.arange(n), jnp.arange(n), indexing="ij"))
    scale = std * jnp.sqrt(shape[0] * shape[1]) / jnp.maximum(rank, 1.0) ** 2
    return jnp.exp(_from_spectrum((modes * scale).at[:1, :1].set(0.0), shape))


def _from_spectrum(modes: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Transform the first orthonormal cosine modes [..., mode, mode] to images [..., y, x]."""
    n = modes.shape[-1]
    spectrum = jnp.zeros((*modes.shape[:-2], *shape)).at[..., :n, :n].set(modes)
    return idctn(spectrum, axes=(-2, -1), norm="ortho")


def albedo_of_patches(log_albedo: Any, std: Any, patches: Any) -> jax.Array:
    """Compute the albedo of every pixel's patch [y, x]: 1 outside of all patches.

    Args:
        log_albedo: of the patches, in prior standard deviations [patch].
        std: prior standard deviation.
        patches: 1 in the pixels of each patch, 0 elsewhere [patch, y, x].
    """
    return jnp.exp(jnp.tensordot(std * log_albedo, patches, 1))


def substrate_plane(parameters: Parameters, tilt_std: Any, position: Any) -> Any:
    """Compute the heights of the substrate [y, x], um, from its tilt; 0 where that is known to be none. NumPy or JAX.

    Args:
        parameters: of the fit.
        tilt_std: prior standard deviation of the tilt.
        position: (x, y) about the middle of the raster [2, y, x], um.
    """
    return sum(tilt_std * tilt * along for tilt, along in zip(parameters.tilt, position, strict=False))


def moves_of(parameters: Parameters, priors: Priors, n_detectors: int) -> jax.Array:
    """Compute distance [um], polar angle and azimuth [rad] beyond the stated ones [move, detector]; none if known."""
    if not parameters.distance.size and not parameters.aim.size:
        return jnp.zeros((0, n_detectors))
    found = priors.geometry @ jnp.concatenate([parameters.distance, parameters.aim.ravel()])
    distance, aim = found[: parameters.distance.size], found[parameters.distance.size :]
    return jnp.concatenate(
        [
            jnp.broadcast_to(jnp.sum(distance), (1, n_detectors)),
            aim.reshape(n_detectors, 2).T if aim.size else jnp.zeros((2, n_detectors)),
        ]
    )


def moved_optics(optics: Optics, moves: Any) -> Optics:
    """Move a stated geometry by distance, polar angle and azimuth [move, detector]; no moves: as stated."""
    return optics if not len(moves) else _moved(optics, moves)


@in_own_precision
@compiled
def _moved(optics: Optics, moves: Any) -> Optics:
    return optics.moved(distance=moves[0, 0], polar=moves[1], azimuth=moves[2])


def law_of(parameters: Parameters, priors: Priors) -> Law | None:
    """Make the scattering law of parameters; None: the cosine law."""
    return None if priors.law is None else priors.law.at(parameters.law)


def readout_of(parameters: Parameters, priors: Priors, drift_modes: Any, slow_axis: int) -> Readout:
    """Make the read-out of parameters."""
    return Readout(
        gain=jnp.exp(priors.gain * parameters.log_gain),
        offset=priors.offset * parameters.offset,
        drift=priors.drift[:, None] * parameters.drift,
        drift_modes=drift_modes,
        lines=priors.lines[:, None] * parameters.lines,
        slow_axis=slow_axis,
    )
