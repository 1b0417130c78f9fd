"""Whether the micrographs support a height map: the map is traced, and its micrographs are compared with the data.

A method's own residuals test little: three images fit three unknowns of every pixel, and a robust fit sets aside what
it cannot explain. Here the heights alone must explain the data, with masks and multiple scattering traced on the
finished map, and nothing but counting noise, the tracer's error and what the beam does not see is allowed for.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax
import numpy as np
from scipy.ndimage import uniform_filter

from helio_jax.errors import PredictionError
from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.render import Corrections, single_scattering
from helio_jax.forward.surface import surface_of_heights
from helio_jax.instrument import Instrument
from helio_jax.inverse.albedo_patches import AlbedoPatches
from helio_jax.inverse.linear import signal_of
from helio_jax.inverse.quality import contradicted_regions, squares
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction
from helio_jax.validity import CHI_SQUARE_LIMIT, REASONS, contradicted_share

if TYPE_CHECKING:
    from helio_jax.inverse.problem import FitProblem
    from helio_jax.inverse.state import FitState

MULTIPLE_ERROR = 0.1
"""Assumed relative error of the traced multiple scattering: of paths, raster and what lies outside the image."""
MODEL_ERROR = 0.01
"""Assumed relative error of the traced signal: of facets as large as a pixel. Counts without noise need it."""
EDGE_PLACE = 12.0**-0.5
"""Standard deviation of the place of an edge of the image, anywhere within a pixel [pixels]."""
_NOISE = 2.0
"""Second differences of the data up to so many of their standard deviations are taken for noise."""
_CONTRADICTED = REASONS.index("contradicts the data")

Trace = Callable[..., Corrections]
"""(heights [y, x] um, unit normals [y, x, 3], instrument) -> masks and multiple scattering, both traced."""


def edge_std(data: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Compute the standard deviation of data by where within its pixel an edge of the image lies [detector, y, x].

    A map that is known from pixel to pixel shows masks and walls up to half a pixel off. The size of an edge is the
    largest second difference of the data in four directions, beyond that of noise: a smooth image has none.

    Args:
        data: NaN where not observed [detector, y, x].
        variance: of the data [detector, y, x].
    """
    ny, nx = data.shape[1:]
    room = np.pad(data, ((0, 0), (1, 1), (1, 1)), mode="edge")
    beside = lambda dy, dx: room[:, 1 + dy : 1 + dy + ny, 1 + dx : 1 + dx + nx]  # noqa: E731
    ways = (0, 1), (1, 0), (1, 1), (1, -1)
    change = np.max([np.abs(np.nan_to_num(beside(*w) - 2.0 * data + beside(-w[0], -w[1]))) for w in ways], axis=0)
    return EDGE_PLACE * np.maximum(change - _NOISE * np.sqrt(6.0 * np.nan_to_num(variance)), 0.0)


def data_std(variance: np.ndarray, model: np.ndarray, corrections: Corrections, albedo: np.ndarray) -> np.ndarray:
    """Compute the standard deviation of data about a traced map [detector, y, x]: noise, tracer, what is not seen.

    Args:
        variance: of the data [detector, y, x].
        model: expected data [detector, y, x].
        corrections: per albedo of the own pixel.
        albedo: [y, x].
    """
    unseen = [image for image in (corrections.occluded, corrections.surroundings) if image is not None]
    traced = albedo**2 * ((MULTIPLE_ERROR * corrections.multiple) ** 2 + sum(image**2 for image in unseen))
    return np.sqrt(variance + (MODEL_ERROR * model) ** 2 + traced)


def local_chi_square(residuals: np.ndarray, is_observed: np.ndarray) -> np.ndarray:
    """Compute the mean square residual of every pixel and its neighbours [y, x].

    Data that were not observed, or lie outside the image, count as deviating by one standard deviation.

    Args:
        residuals: in standard deviations [detector, y, x].
        is_observed: whether there is a datum [detector, y, x].
    """
    square = np.where(is_observed, squares(residuals), 1.0).mean(0)
    return uniform_filter(square, 3, mode="constant", cval=1.0)


@dataclass(frozen=True)
class Misfit:
    """What the micrographs traced on a height map differ by from the data, in units of the beam.

    Attributes:
        difference: model minus data, NaN where not observed [detector, y, x].
        std: standard deviation of the data about the model [detector, y, x].
        form_factor: of the heights, without masks [detector, 3, y, x].
        normals: of the heights [y, x, 3].
    """

    difference: np.ndarray
    std: np.ndarray
    form_factor: np.ndarray
    normals: np.ndarray

    @property
    def residuals(self) -> np.ndarray:
        """(model - data) / standard deviation [detector, y, x]."""
        return self.difference / self.std


def misfit_of_map(stack: MicrographStack, rec: Reconstruction, patches: AlbedoPatches, trace: Trace) -> Misfit:
    """Trace a photometric height map and compare it with the data.

    The normals are those of the heights, not of the photometric solution; the albedo is that of the patches.

    Raises:
        PredictionError: the map is too rough or steep to be traced.
    """
    signal, variance = signal_of(stack)
    optics = Optics.of(rec.instrument)
    with jax.enable_x64(True):
        normals = surface_of_heights(rec.height, Raster.of(stack)).normals(optics.beam_shift)
    c, albedo = trace(rec.height, normals, rec.instrument, **patches.known), patches.albedo
    phi = form_factor(optics, rec.height)
    single = single_scattering(phi - c.masked, np.moveaxis(normals, -1, 0))
    model = albedo * (single + (0.0 if stack.is_without_multiple else c.multiple))
    return Misfit(model - signal, data_std(variance, model, c, albedo), albedo * phi, normals)


def _traced_state(problem: "FitProblem", state: "FitState", trace: Trace) -> tuple["FitState", np.ndarray, np.ndarray]:
    """Trace a fit's surface; return the state with what was traced, model minus data, NaN where not observed, and the
    standard deviation of the data [detector, y, x]."""
    from helio_jax.inverse.state import predict_corrections
    from helio_jax.inverse.steps import expected

    state = predict_corrections(problem, state, trace)
    albedo = problem.albedo_at(state.parameters)
    model = expected(problem, state, is_noisy=True)
    std = data_std(problem.variance, model, state.held.corrections, albedo)
    return state, np.where(problem.is_observed, model - problem.signal, np.nan), std


def misfit_of_state(problem: "FitProblem", state: "FitState", trace: Trace) -> Misfit:
    """Trace a fit's surface and compare it, with the fit's albedo and read-out, with the data.

    Raises:
        PredictionError: the surface is too rough or steep to be traced.
    """
    from helio_jax.inverse.parameters import moved_optics

    state, difference, std = _traced_state(problem, state, trace)
    optics = moved_optics(problem.optics, problem.moves(state.parameters))
    gain = np.exp(problem.priors.gain * state.parameters.log_gain)[:, None, None, None]
    phi = gain * problem.albedo_at(state.parameters) * form_factor(optics, state.surface.height)
    return Misfit(difference, std, phi, state.surface.normals(problem.shift))


def residuals_of_state(problem: "FitProblem", state: "FitState", trace: Trace) -> np.ndarray:
    """Compute (model - data) / standard deviation of a fit's surface, albedo and read-out [detector, y, x].

    To rank explanations: edges of the image count as known to a pixel only (`edge_std`), or the places of the edges
    would decide, of which no map on this raster knows more. Data that were not observed have none: 0. Raises as
    `misfit_of_state`.
    """
    _, difference, std = _traced_state(problem, state, trace)
    return np.nan_to_num(difference / np.hypot(std, edge_std(problem.signal, problem.variance)))


def expected_chi_square(stack: MicrographStack, instrument: Instrument, chi_square: np.ndarray) -> float:
    """Compute the chi-square of a right map: 1, or the median where misfit common to the image is not the map's.

    It is that of the instrument or of the calibration, where the one is uncertain or the other had to be made.
    """
    is_uncertain = instrument.uncertainty.is_stated or stack.calibration is not None
    return max(1.0, float(np.median(chi_square))) if is_uncertain else 1.0


def judged(
    rec: Reconstruction,
    stack: MicrographStack,
    residuals: Callable[[], np.ndarray],
    region: np.ndarray | None = None,
) -> Reconstruction:
    """Return a height map with the verdict of its data: chi-square, reasons, and a sentence in its status.

    Pixels must deviate by more than `CHI_SQUARE_LIMIT` times the chi-square of a right map (`expected_chi_square`), or
    belong to a region in which so many do (`contradicted_regions`).

    Args:
        rec: the height map.
        stack: its micrographs.
        residuals: computes (model - data) / standard deviation of the traced map [detector, y, x]; a PredictionError
            means that the map cannot be traced, which contradicts the data, too.
        region: from `regions` [y, x]; None: depth jumps part nothing.
    """
    try:
        found = np.where(stack.is_observed, residuals(), np.nan)
    except PredictionError:
        reason = np.where(rec.reason == 0, _CONTRADICTED, rec.reason)
        said = "contradicts the data: no micrographs can be traced on a height map so rough or steep"
        return rec.replace(reason=reason, is_valid=reason == 0, status=f"{said}; {rec.status}")
    chi_square = local_chi_square(found, stack.is_observed)
    right = expected_chi_square(stack, rec.instrument, chi_square)
    is_worse = chi_square > CHI_SQUARE_LIMIT * right
    if region is not None:
        is_worse |= contradicted_regions(is_worse, region)
    reason = np.where((rec.reason == 0) & is_worse, _CONTRADICTED, rec.reason)
    names, square = stack.instrument.detector_names, np.where(stack.is_observed, squares(found), 0.0)
    by_detector = square.sum((1, 2)) / np.maximum(stack.is_observed.sum((1, 2)), 1)
    about = {"traced_chi_square": dict(zip(names, by_detector.tolist(), strict=True))}
    judged = rec.replace(
        chi_square=chi_square, reason=reason, is_valid=reason == 0, provenance={**rec.provenance, **about}
    )
    if not judged.is_contradicted:
        return judged
    worst = names[int(np.argmax(by_detector))]
    said = (
        f"contradicts the data: micrographs traced on this height map deviate from the measured ones in "
        f"{contradicted_share(reason):.0%} of the pixels, contradicted regions as a whole included (most in detector "
        f"{worst}): shape, instrument or scattering law are not as assumed"
    )
    return judged.replace(status=f"{said}; {rec.status}")
