"""The variance of the heights that an experiment would leave, as a differentiable function of its optics (JAX).

The same model as `hx.fisher`: residuals, priors, edges and errors that agree between neighbours are those of the fit,
linearised at an assumed surface, the instrument marginalised. There the standard deviations are sampled on the host;
here they come from the dense information matrix, so that they are exact, and their gradient by reverse mode moves
apertures to where the heights are known best. Rims of domes (`rims`) count as kinks here. For rasters up to about
31 x 31 with a flat border.

What stays as in the optics that a case was posed with: which edges are at one kink, the raster, the surface. Which
sample is the horizon of a masked point is constant under differentiation (`forward/masking.py`).
"""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from scipy.ndimage import gaussian_filter1d

from helio_jax.arrays import border_mask
from helio_jax.errors import SceneError
from helio_jax.forward.masking import masked_form_factor
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.render import single_scattering
from helio_jax.forward.surface import Surface, along, unit_normal
from helio_jax.instrument import Uncertainty
from helio_jax.inverse.correlated_errors import EdgeError, averaged_std
from helio_jax.inverse.edges import NOISE_FLOOR, around, kink_size, trapezoid_gap
from helio_jax.inverse.fisher import pose_experiment
from helio_jax.inverse.parameters import Parameters
from helio_jax.inverse.posterior import block_derivatives, tilts_of
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.residuals import SLOPE_STD, Edges, FixedTerms, Unknowns, second_order_noise_bias
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings
from helio_jax.inverse.state import masked_moves
from helio_jax.inverse.steps import NOISY, edges_of, expand_form_factors, freeze, steepness
from helio_jax.robust import cauchy_weight

MAX_PIXELS = 1000
"""Largest raster of a case: the information matrix is dense, three unknowns a pixel."""
BORDER_SHARE = 0.06
"""Width of the border, over the raster's, whose heights do not count: they are held."""


class EdgeTerms(NamedTuple):
    """What is constant of the edges along one axis.

    Attributes:
        misfit: of the trapezoid rule [edge].
        variance: of that rule by kinks and curvature, without noise [edge].
        kink: change of the slope at a kink [edge].
        of_height: derivative of the misfits by the heights [edge, pixel], 1/um.
        mean: that takes the mean of the slopes at the two ends [edge, pixel].
        second: second difference of the slopes along the axis [pixel, pixel].
    """

    misfit: Any
    variance: Any
    kink: Any
    of_height: Any
    mean: Any
    second: Any


class Case(eqx.Module):
    """One sample with its raster, as it is posed for a number of apertures.

    Attributes:
        surface: assumed.
        raster: beam positions.
        dose: beam atoms per pixel times detection efficiency [detector].
        background: counts per pixel [detector].
        unknowns, fixed: of the linearised fit; what depends on the optics is replaced.
        edge_x, edge_y: constant terms of the edges.
        run: number of the run of edges that share the place of a kink, 0: of none [edge].
        agreement: covariance of prediction errors between pixels of variance 1, along y and along x.
        counted: pixels whose heights count [pixel].
        relief: range of the heights [um].
        names: of the instrument parameters, static.
        settings: of the fit, static.
        is_masked: whether masks are modelled, static.
    """

    surface: Surface
    raster: Raster
    dose: Any
    background: Any
    unknowns: Unknowns
    fixed: FixedTerms
    edge_x: EdgeTerms
    edge_y: EdgeTerms
    run: Any
    agreement: tuple[Any, Any]
    counted: Any
    relief: Any
    names: tuple[str, ...] = eqx.field(static=True)
    settings: RefineSettings = eqx.field(static=True)
    is_masked: bool = eqx.field(static=True)


class Expectation(NamedTuple):
    """What an experiment would determine, and what it would record.

    Attributes:
        variance: of every height [y, x], um^2.
        masked: share of the aperture that the sample masks, mean over detectors and pixels.
        counts: expected counts per pixel from the sample, summed over the detectors, mean over the pixels.
    """

    variance: Any
    masked: Any
    counts: Any


def pose_case(
    height: Any,
    optics: Optics,
    raster: Raster,
    dose: Any,
    *,
    background: Any = 0.0,
    uncertainty: Uncertainty | None = None,
    settings: ReconstructSettings | None = None,
    is_masked: bool = True,
) -> Case:
    """Pose a sample for `expect_errors`; arguments as those of `hx.fisher`.

    Raises:
        SceneError: a free border, several beams, or a raster of more than `MAX_PIXELS`.
    """
    settings = settings or ReconstructSettings()
    if settings.border != "flat":
        raise SceneError(
            f"a criterion of apertures needs reconstruct.border = 'flat', got {settings.border!r}: its level is not "
            "modelled here; set it to 'flat', or use hx.fisher"
        )
    if optics.beam_shifts is not None:
        raise SceneError("a criterion of apertures is for one beam, got one for each detector: give a single scan")
    if (n := int(np.prod(raster.shape))) > MAX_PIXELS:
        raise SceneError(f"a criterion of apertures takes at most {MAX_PIXELS} pixels, got {n}: coarsen the raster")
    kind = "masking" if is_masked else "none"
    problem, state = pose_experiment(height, optics, raster, dose, background, uncertainty, settings, kind, 1.0)
    s, surface = settings.refine, state.surface
    cut = s.jump_limits[-1]
    unknowns, fixed = freeze(problem, state, s.robust_limits[-1], cut)
    found = edges_of(problem, surface, cut)
    run = EdgeError.of(surface, *found).run
    reach = s.error_reach * float(np.ptp(surface.height))
    n_detectors = optics.n_detectors
    with jax.enable_x64(True):
        names = _names(unknowns.parameters)
        case = Case(
            surface, raster,
            np.broadcast_to(np.asarray(dose, float), n_detectors).copy(),
            np.broadcast_to(np.asarray(background, float), n_detectors).copy(),
            unknowns, fixed,
            _edge_terms(problem, surface, 1), _edge_terms(problem, surface, 0), run,
            (_agreement(raster.shape[0], reach / raster.dy), _agreement(raster.shape[1], reach / raster.dx)),
            ~border_mask(raster.shape, BORDER_SHARE).ravel(),
            np.asarray(np.ptp(surface.height)), names, s, is_masked,
        )  # fmt: skip
    return case


def _names(parameters: Parameters) -> tuple[str, ...]:
    return tuple(f"{n}{list(i)}" for n in parameters.free() for i in np.ndindex(getattr(parameters, n).shape))


def _edge_terms(problem: FitProblem, surface: Surface, axis: int) -> EdgeTerms:
    """Compute what of the edges along an axis does not depend on the optics."""
    slope, pitch = (surface.slope_x, problem.raster.dx) if axis == 1 else (surface.slope_y, problem.raster.dy)
    slope, height = np.asarray(slope), np.asarray(surface.height)
    kink, (before, after) = kink_size(slope, axis), along(slope, axis)
    curvature = np.gradient(after - before, axis=axis) if slope.shape[axis] > 2 else np.zeros_like(before)
    pixel = np.arange(height.size).reshape(height.shape)
    first, last = (end.ravel() for end in along(pixel, axis))
    edge = np.arange(first.size)
    of_height, mean = np.zeros((edge.size, pixel.size)), np.zeros((edge.size, pixel.size))
    of_height[edge, last], of_height[edge, first] = 1.0 / pitch, -1.0 / pitch
    mean[edge, last] = mean[edge, first] = 0.5
    # to the next less to the previous: 0 beyond the border, as in `edges.fourth_order_slopes`
    difference = (of_height * pitch).T
    second = -difference @ difference.T
    return EdgeTerms(
        trapezoid_gap(height, slope, pitch, axis).ravel(), (kink**2 / 12.0 + (curvature / 12.0) ** 2).ravel(),
        kink.ravel(), of_height, mean, second,
    )  # fmt: skip


def _agreement(n: int, length: float) -> np.ndarray:
    """Compute the covariance [n, n] of white noise that is averaged as `correlated_errors.ModelError` does."""
    average = gaussian_filter1d(np.eye(n), length, axis=0) if length > 0.0 else np.eye(n)
    average = average / averaged_std(length)
    return average @ average.T


def expect_errors(case: Case, optics: Optics, is_smooth: Any = False) -> Expectation:
    """Compute the variances of the heights, the masked share and the count rate under other optics; differentiable.

    The optics may differ in every number but the number of apertures and the beam, along which the surface is seen.
    Agrees with `hx.fisher` within its sampling error.

    Args:
        case: from `pose_case`.
        optics: JAX arrays in float64.
        is_smooth: the fit takes the median over all data for the noise of slopes, and of each detector for the priors;
            where pixels or detectors exchange their ranks the gradient jumps, which ends a search too early. True:
            interquartile means of the pixels, for the noise their geometric mean over the detectors.

    Source: Cramer-Rao bound as in `posterior.sample_posterior`, whose sandwich it takes in closed form:
        White, Econometrica 48 (1980) 817.
    """
    fixed, error_share, floor, masked, counts = _terms_at(case, optics, is_smooth)
    data, data_by, (*edges_by, border_by), raised, scale = block_derivatives(case.unknowns, fixed)
    free = case.unknowns.parameters.free()
    n, shape = data[0][0].size, case.surface.height.shape

    def by_parameter(blocks: dict[str, Any], *rows: int) -> jax.Array:
        return jnp.concatenate([blocks[name].reshape(*rows, -1) for name in free], -1)

    own = jnp.stack(data, 1).reshape(len(data[0]), 3, n)
    of_data = own, by_parameter(data_by, len(own), n)
    edges = [
        (*rows, by_parameter(blocks, len(rows[0])))
        for rows, blocks in zip(_edge_rows(case, fixed, raised, scale), edges_by, strict=True)
    ]
    others = sum(_of_edges(rows, axis) for rows, axis in zip(edges, (1, 0), strict=True))
    others = others + _of_border(case, by_parameter(border_by, n))
    information = _of_data(*of_data) + others
    wanted = jnp.eye(len(information), n)
    if tilts := tilts_of(case.names):  # above the tilted substrate
        planes = (case.fixed.priors.tilt * case.fixed.position).reshape(2, n)
        wanted = wanted.at[3 * n + np.array(tilts)].set(-planes)
    answer = cho_solve(cho_factor(information, lower=True), wanted)
    spread = _of_data(*of_data, error_share, case.agreement) + others if case.is_masked else information
    variance = jnp.sum(answer * (spread @ answer), 0)
    misfits = jnp.concatenate([_applied(rows, axis, answer) for rows, axis in zip(edges, (1, 0), strict=True)])
    common = _common_share(case, floor)[:, None] * misfits
    together = jax.ops.segment_sum(common, case.run, len(common) + 1)
    variance = variance + jnp.sum(together**2, 0) - jnp.sum(common**2, 0)
    return Expectation(variance.reshape(shape), masked, counts)


def _of_data(own: Any, images: Any, error_share: Any = None, agreement: Any = None) -> jax.Array:
    """Compute J' C J of the data's rows J, C being the covariance of the data in the deviations that the fit assumes.

    Args:
        own: derivative of the data by the own pixel's height and slopes [detector, field, pixel].
        images: by the parameters [detector, pixel, parameter].
        error_share: share of prediction errors in the variance [detector, pixel]; default: C = 1.
        agreement: covariance of these errors between pixels along y and x.
    """
    n, m = own.shape[2], images.shape[2]
    counts = jnp.ones((len(own), n)) if error_share is None else 1.0 - error_share
    blocks = jnp.einsum("kan,kbn,kn->abn", own, own, counts)
    surface = jnp.einsum("abi,ij->aibj", blocks, jnp.eye(n))
    both = jnp.einsum("kan,knp,kn->anp", own, images, counts)
    parameters = jnp.einsum("knp,knq,kn->pq", images, images, counts)
    if error_share is not None:
        std = _root(error_share)
        together = jnp.kron(*(jnp.asarray(c) for c in agreement))
        own, images = own * std[:, None], images * std[..., None]
        of_images = jnp.einsum("ij,kjp->kip", together, images)
        surface = surface + jnp.einsum("kai,kbj->aibj", own, own) * together[None, :, None, :]
        both = both + jnp.einsum("kan,knp->anp", own, of_images)
        parameters = parameters + jnp.einsum("knp,knq->pq", images, of_images)
    surface, both = surface.reshape(3 * n, 3 * n), both.reshape(3 * n, m)
    return jnp.block([[surface, both], [both.T, parameters]])


def _root(square: jax.Array) -> jax.Array:
    """Compute the square root, with derivative 0 instead of infinity at 0."""
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)


def _edge_rows(case: Case, fixed: FixedTerms, raised: Any, scale: Any) -> list[tuple[jax.Array, jax.Array]]:
    """Compute the derivatives of the edges' residuals by the heights and by the slopes along the edge [edge, pixel].

    Along x and along y.
    """
    out, edges, n = [], fixed.edges, case.surface.height.size
    for terms, weight, smooth, by_height in (
        (case.edge_x, edges.inverse_std_x, edges.smooth_x, raised[0]),
        (case.edge_y, edges.inverse_std_y, edges.smooth_y, raised[1]),
    ):
        of_slope = terms.mean - (terms.mean * (smooth.ravel() / 12.0)) @ terms.second
        w = (scale * weight).reshape(-1, 1)
        # the last term: through the scale of all edges, which follows the mean height
        out.append((w * terms.of_height + by_height.reshape(-1, 1) / n, -w * of_slope))
    return out


def _of_edges(rows: tuple[jax.Array, jax.Array, jax.Array], axis: int) -> jax.Array:
    """Compute J' J of rows by heights, by slopes along an axis and by parameters, in the place of all unknowns."""
    dense, n, m = jnp.concatenate(rows, 1), rows[0].shape[1], rows[2].shape[1]
    square = dense.T @ dense
    place = jnp.concatenate([jnp.arange(n), (2 - axis) * n + jnp.arange(n), 3 * n + jnp.arange(m)])
    return jnp.zeros((3 * n + m, 3 * n + m)).at[jnp.ix_(place, place)].set(square)


def _applied(rows: tuple[jax.Array, jax.Array, jax.Array], axis: int, unknowns: jax.Array) -> jax.Array:
    """Apply such rows to unknowns [unknown, ...]."""
    (height, slope, parameter), n = rows, rows[0].shape[1]
    start = (2 - axis) * n
    return height @ unknowns[:n] + slope @ unknowns[start : start + n] + parameter @ unknowns[3 * n :]


def _of_border(case: Case, by_parameter: jax.Array) -> jax.Array:
    """Compute J' J of the border's heights, with the priors of slopes and parameters."""
    (n, m), weight = by_parameter.shape, jnp.asarray(case.fixed.border).ravel()
    diagonal = jnp.concatenate([weight**2, jnp.full(2 * n, SLOPE_STD**-2), jnp.ones(m)])
    both = jnp.concatenate([weight[:, None] * by_parameter, jnp.zeros((2 * n, m)), by_parameter.T @ by_parameter])
    parameters = slice(3 * n, None)
    out = jnp.diag(diagonal).at[:, parameters].add(both)
    return out.at[parameters, : 3 * n].add(both[: 3 * n].T)


def _common_share(case: Case, floor: Any) -> jax.Array:
    """Compute the root of the share of every edge's variance that its run has in common [edge], x then y."""
    kink = jnp.concatenate([case.edge_x.kink, case.edge_y.kink])
    variance = floor**2 + jnp.concatenate([case.edge_x.variance, case.edge_y.variance])
    return jnp.where(case.run > 0, kink / jnp.sqrt(12.0 * variance), 0.0)


class _Terms(NamedTuple):
    """Terms of the linearised fit, and share of prediction errors in the variance [detector, pixel]; least deviation of
    the edges; masked share; counts per pixel."""

    fixed: FixedTerms
    error_share: Any
    floor: Any
    masked: Any
    counts: Any


def _terms_at(case: Case, optics: Optics, is_smooth: Any) -> _Terms:
    """Compute what `fisher.pose_experiment` and `steps.freeze` would, in JAX."""
    f, s, surface, dose = case.fixed, case.settings, case.surface, case.dose[:, None, None]
    moved, height = f.form_factors.moved, jnp.asarray(surface.height)
    masked = jnp.zeros((optics.n_detectors, 3, *height.shape))
    moves = jnp.zeros((len(moved), *masked.shape))
    if case.is_masked:
        masked = masked_form_factor(surface, optics, case.raster)
        moves = masked_moves(surface, optics, case.raster, moved) if len(moved) else moves
    factors = expand_form_factors(optics, moved, height, (masked, moves, moved))
    normal = unit_normal(jnp.asarray(surface.slope_x), jnp.asarray(surface.slope_y), optics.beam_shift)
    signal = single_scattering(factors.terms[0], normal)
    visible = dose * jnp.maximum(signal, 0.0)
    variance = jnp.maximum(visible + case.background[:, None, None], 1.0) / dose**2
    median = jnp.where(is_smooth, _interquartile_mean(signal), jnp.median(signal, axis=(1, 2)))
    relative = variance / median[:, None, None] ** 2
    smoothed = jnp.exp(jnp.mean(jnp.log(_interquartile_mean(relative))))
    noise = jnp.clip(jnp.sqrt(jnp.where(is_smooth, smoothed, jnp.median(relative))), 1e-3, 1.0)
    hidden = single_scattering(masked, normal)
    assumed = (s.mask_error * hidden) ** 2 + (0.5 * _largest_change(hidden)) ** 2
    inverse_sigma = 1.0 / jnp.sqrt(variance + assumed)
    slopes = jnp.asarray(surface.slope_x), jnp.asarray(surface.slope_y)
    largest = NOISY * noise * steepness(*slopes)
    bias = second_order_noise_bias(
        surface, factors.terms[0], jnp.zeros_like(signal), optics, None, inverse_sigma, largest
    )
    of_median = "offset", "drift", "discrepancy", "lines"  # stated as shares of the median signal
    ratio = median / (f.priors.offset / s.offset_std)
    priors = replace(f.priors, **{name: ratio * getattr(f.priors, name) for name in of_median})
    fixed = replace(
        f,
        inverse_sigma=inverse_sigma,
        form_factors=factors,
        multiple=jnp.zeros_like(signal),
        noise_bias=bias,
        priors=priors,
        edges=_edges_at(case, noise),
        optics=optics,
    )
    share = (assumed / (variance + assumed)).reshape(len(signal), -1)
    own = factors.terms[0] + masked
    of_aperture = jnp.sum(masked * own, 1) / jnp.sum(own**2, 1)
    return _Terms(fixed, share, NOISE_FLOOR * noise, jnp.mean(of_aperture), jnp.mean(jnp.sum(visible, 0)))


def _interquartile_mean(image: jax.Array) -> jax.Array:
    """Compute the mean of the middle half of every image's pixels [detector]."""
    ordered = jnp.sort(image.reshape(len(image), -1), 1)
    quarter = ordered.shape[1] // 4
    return jnp.mean(ordered[:, quarter : ordered.shape[1] - quarter], 1)


def _edges_at(case: Case, noise: Any) -> Edges:
    """Weight the edges as `edges.find_edges` and `edges.smoothness_weight` do, for a slope noise."""
    weights, smooth, (ny, nx) = [], [], case.surface.height.shape
    for terms, axis, shape in ((case.edge_x, 1, (ny, nx - 1)), (case.edge_y, 0, (ny - 1, nx))):
        sigma = jnp.sqrt((NOISE_FLOOR * noise) ** 2 + terms.variance)
        joined = cauchy_weight(terms.misfit / sigma, case.settings.jump_limits[-1]) ** 2
        weights.append((joined.reshape(shape), (jnp.sqrt(joined) / sigma).reshape(shape)))
        own = joined * cauchy_weight(terms.kink / 24.0, NOISE_FLOOR * noise)
        previous, following = around(own.reshape(shape), axis)
        smooth.append(previous * following)
    (joined_x, weight_x), (joined_y, weight_y) = weights
    smooth_x, smooth_y = smooth
    no_rims = jnp.zeros((ny, nx - 1)), jnp.zeros((ny - 1, nx))
    return Edges(joined_x, joined_y, weight_x, weight_y, smooth_x, smooth_y, *no_rims)


def _largest_change(image: jax.Array) -> jax.Array:
    """Compute what `state.prediction_std` does: the largest difference of every pixel from its neighbours."""
    padded = jnp.pad(image, ((0, 0), (1, 1), (1, 1)), mode="edge")
    ny, nx = image.shape[1:]
    around_it = jnp.stack([padded[:, i : i + ny, j : j + nx] for i in range(3) for j in range(3)])
    return jnp.maximum(jnp.max(around_it, 0) - image, image - jnp.min(around_it, 0))
