"""Fit of an instrument to scans of objects of known shape: Levenberg-Marquardt with the derivatives of the model.

The unknowns of `unknowns`, each with a prior, are fitted to one or several scans at once; plate, beam and apertures are
common to all scans, each scan has its own object and read-out. Weights are robust (Cauchy); offsets of single scan
lines, and errors of the model that tiles of pixels share, are marginalised, their variances estimated from the
residuals (`common_errors`). Weights, multiple scattering, and on which part of the scene every pixel lies
(expectation-maximisation), are computed anew in every round, for its geometry.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from helio_jax.arrays import pitch, robust_std
from helio_jax.calibration.common_errors import (
    TILE,
    Groups,
    common_std,
    enlargement,
    group_means,
    scan_lines,
    tiles,
    whitened,
)
from helio_jax.calibration.known_model import (
    Multiple,
    Seen,
    expand_multiple,
    fitted,
    fitted_and_derivative,
    no_multiple,
    parts,
    probability,
    radiosity_at,
    radiosity_plan,
    see,
    smoothed_by,
)
from helio_jax.calibration.known_objects import KnownObject
from helio_jax.calibration.known_pixels import (
    BESIDE,
    CONVERGED,
    NARROWEST,
    OUTLINE,
    SETTLED,
    beside_outline,
    membership,
    near_foot,
)
from helio_jax.calibration.known_scan import (
    InstrumentFit,
    KnownScan,
    Layout,
    expected_counts,
    linear_start,
    moved_instrument,
    one_instrument,
    prepare_scan,
    stride_for,
    thinned,
)
from helio_jax.calibration.known_start import started
from helio_jax.calibration.unknowns import KnownShapeSettings, instrument_unknowns
from helio_jax.errors import GuardError
from helio_jax.forward.optics import Raster
from helio_jax.instrument import Instrument
from helio_jax.micrograph import MicrographStack
from helio_jax.robust import cauchy_weight

TILES_ACROSS = 6
"""Tiles across an object within which the model's error is the same, if each of them has `TILE` pixels or more."""
RADIOSITY_PIXELS = 25, 25, 61
"""Pixels along the longer side of the raster on which multiple scattering is derived, about: in the first rounds and
all later ones. On a coarse raster the derivatives are wrong about an object's foot, where they are largest."""
MOST_SMOOTHED = 151
"""Pixels along the longer side of a raster, at most, on which the noise of traced multiple scattering is smoothed by
radiosity: there it takes 10 s and 1.6 GB, with 201 of them 27 s and 3.2 GB."""
STALE, OLD = 8.0, 0.5
"""Changes of an unknown [standard deviations] after which the derivatives of the multiple scattering are computed anew,
and after which it is traced anew."""
THRIFT = 8
"""So many times fewer paths are traced while the unknowns still move far."""
FIRST_PIXELS = 61
"""Pixels along the longer side of the thinned raster on which the unknowns are first fitted."""
_STEPS, _FTOL = 30, (1e-4, 1e-6)
"""Steps of a round, and relative change of the cost at which it ends: far off, and near."""
Trace = Callable[[int, Instrument, dict[str, float], Raster, int], np.ndarray]
"""Traces the multiple scattering of a scan [detector, y, x]: its number, the instrument, the numbers of the object by
their names [um, rad], the raster, how many times fewer paths will do. The substrate's albedo is at most 1, so is the
object's."""


@dataclass(frozen=True)
class KnownFit(InstrumentFit):
    """Result of the fit.

    Attributes (those of `InstrumentFit`, and):
        linear: of every scan, gain and the columns [detector, column].
        linear_covariance: of these, detector by detector [detector, column, column], per scan.
        residuals: in standard deviations, NaN where not used [detector, y, x], per scan.
        expected: readings [detector, y, x], per scan.
        weights: robust weights of the pixels [detector, y, x], per scan.
        seen: where the pixels lie, per scan.
        line_std: offsets of single scan lines, counts [detector], per scan.
        model_error: of tiles of the substrate and of the object, counts [detector, part], per scan.
        chi_square: mean square of the weighted residuals over their expected one.
        inflation: by which the standard deviations were enlarged for misfit and correlated residuals.
        rounds, is_converged: of the fit.
    """

    linear: list[np.ndarray]
    linear_covariance: list[np.ndarray]
    residuals: list[np.ndarray]
    expected: list[np.ndarray]
    weights: list[np.ndarray]
    seen: list[Seen]
    line_std: list[np.ndarray]
    model_error: list[np.ndarray]
    chi_square: float
    inflation: float
    rounds: int
    is_converged: bool


class _Fit:
    """State of one fit; `fit_known_shapes` runs it."""

    def __init__(
        self, stated: Instrument, scans: list[KnownScan], settings: KnownShapeSettings, trace: Trace | None
    ) -> None:
        self.stated, self.scans, self.settings, self.trace = stated, scans, settings, trace
        self.rounds_before = 0  # of a fit of fewer pixels, whose radiosity is coarse
        self.layout = Layout(instrument_unknowns(stated, settings), scans)
        self.x = np.zeros(len(self.layout.unknowns))
        self.line_groups = [scan_lines(s.model.raster.shape, s.slow_axis) for s in scans]
        self.lines = [np.zeros(len(s.counts)) for s in scans]
        self.tiles = [_tiles_of(see(s.model, self.layout.of_scan(i, self.x))) for i, s in enumerate(scans)]
        self.model_error = [np.zeros((len(s.counts), 2)) for s in scans]  # of substrate and object [detector, part]
        self.stage = 0  # of the outline, which is narrowed from one to the next
        # settled at the narrowest outline: misfit is the model's error, no longer that of the unknowns
        self.is_near = False
        # errors of lines and tiles are then held: estimated from residuals that they have shaped, they only grow
        self.is_error_known = False
        self.multiple: list[Multiple] = [
            no_multiple(s.model, self.layout.of_scan(i, self.x), self.layout.free[i]) for i, s in enumerate(scans)
        ]
        self.expanded_at = [np.full(len(self.x), np.inf) for _ in scans]
        self.traced_at = [np.full(len(self.x), np.inf) for _ in scans]  # with all paths
        self.width = [OUTLINE[0] * _outline_pitch(s) for s in scans]
        self.deviation = np.ones(len(self.x))
        self.weights = [np.ones(s.counts.shape) for s in scans]
        self.used = [s.is_used for s in scans]
        self.outlined = [s.is_used.any(0) for s in scans]  # pixels that tell where the outline lies [y, x]
        start = [probability(s.model, self.layout.of_scan(i, self.x), self.multiple[i]) for i, s in enumerate(scans)]
        self.is_beside = [np.zeros(s.counts.shape[1:], bool) for s in scans]  # pixels too close to an outline [y, x]
        self.member: list[np.ndarray] = [np.zeros(0)] * len(scans)
        self.linear = [
            linear_start(s, p, np.where(s.is_used, 1.0 / s.sigma, 0.0), settings)
            for s, p in zip(scans, start, strict=True)
        ]
        self.mean = [a.copy() for a in self.linear]
        self.prior = [s.linear_priors(a[:, 0], settings) for s, a in zip(scans, self.linear, strict=True)]
        self.offsets = np.cumsum([len(self.x), *(a.size for a in self.linear)])

    def start_at(self, first: "_Fit") -> None:
        """Begin where a fit of fewer pixels has ended."""
        self.x, self.linear, self.deviation = first.x, first.linear, first.deviation
        self.is_near, self.stage, self.rounds_before = first.is_near, first.stage, len(RADIOSITY_PIXELS)

    def split(self, z: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        """Split whitened unknowns into those of the geometry, and the linear ones of the scans [detector, column]."""
        parts = np.split(z, self.offsets[:-1])
        return parts[0], [m + p * v.reshape(m.shape) for m, p, v in zip(self.mean, self.prior, parts[1:], strict=True)]

    def joined(self) -> np.ndarray:
        """Join the present unknowns, whitened."""
        linear = [((a - m) / p).ravel() for a, m, p in zip(self.linear, self.mean, self.prior, strict=True)]
        return np.concatenate([self.x, *linear])

    def inverse(self, i: int) -> np.ndarray:
        """Compute the weights of a scan's data over their noise."""
        return np.where(self.used[i], np.sqrt(self.weights[i]) / self.scans[i].sigma, 0.0)

    def image(self, i: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the detection probability of a scan [detector, y, x], and the residuals of its outline [y, x]."""
        about = self.layout.of_scan(i, x), self.multiple[i], self.width[i], self.member[i]
        return fitted(self.scans[i].model, *about)

    def whitened(self, i: int, weighted: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """Whiten images [..., detector, y, x] for the errors that lines and tiles share; to first order in either."""
        lines, of_tile = self.line_groups[i], self.tiles[i]
        std = np.repeat(self.lines[i][:, None], lines.n, axis=1)
        weighted = whitened(weighted, inverse, std, lines)
        return whitened(weighted, inverse, self.model_error[i][:, np.arange(of_tile.n) % 2], of_tile)

    def residuals(self, z: np.ndarray) -> np.ndarray:
        """Compute all residuals: of the data of all scans, of their outlines, and the priors."""
        x, linear = self.split(z)
        out, outlines = [], []
        for i, scan in enumerate(self.scans):
            image, outline = self.image(i, x)
            inverse = self.inverse(i)
            misfit = (expected_counts(scan, linear[i], image) - scan.counts) * inverse
            out.append(self.whitened(i, misfit, inverse).ravel())
            outlines.append((outline * self.outlined[i]).ravel())
        return np.concatenate([*out, *outlines, z])

    def derivatives(self, z: np.ndarray) -> np.ndarray:
        """Compute the derivatives of the residuals [residual, unknown]."""
        x, linear = self.split(z)
        sizes = [s.counts.size for s in self.scans] + [s.counts[0].size for s in self.scans]
        out = np.zeros((sum(sizes) + len(z), len(z)))
        rows = [slice(end - size, end) for size, end in zip(sizes, np.cumsum(sizes), strict=True)]
        for i, scan in enumerate(self.scans):
            about = self.layout.of_scan(i, x), self.multiple[i], self.width[i], self.member[i]
            (value, _), (slopes, outline_slopes) = fitted_and_derivative(scan.model, *about)
            inverse = self.inverse(i)

            def put(column: int, image: np.ndarray, i=i, inverse=inverse) -> None:
                out[rows[i], column] = self.whitened(i, image * inverse, inverse).ravel()

            for column, slope, of_outline in zip(self.layout.place[i], slopes, outline_slopes, strict=True):
                put(column, linear[i][:, 0, None, None] * slope * self.layout.scale[column])
                moved = of_outline * self.outlined[i] * self.layout.scale[column]
                out[rows[len(self.scans) + i], column] = moved.ravel()
            for k in range(len(value)):
                for c, mode in enumerate((value[k], *scan.columns.modes)):
                    image = np.zeros(value.shape)
                    image[k] = self.prior[i][k, c] * mode
                    put(int(self.offsets[i]) + k * scan.n_linear + c, image)
        out[sum(sizes) :] = np.eye(len(z))
        return out

    def update(self, number: int) -> None:
        """Compute multiple scattering, parts, weights and lines, at the present unknowns."""
        instrument, number = self.fitted(), number + self.rounds_before
        for i, scan in enumerate(self.scans):
            at = self.layout.of_scan(i, self.x)
            own, seen = scan.model.object_of(at), see(scan.model, at)
            if scan.known.kind != "flat":
                self.multiple[i] = self._scattered_again(number, i, at, seen, instrument)
            step = _outline_pitch(scan)
            self.width[i] = OUTLINE[self.stage] * step
            used = scan.is_used & ~near_foot(scan, own, seen.distance, self.settings)
            # a wide outline: the data shall tell on which part a pixel lies, not the present unknowns
            value, log_share = parts(scan.model, at, self.multiple[i], OUTLINE[0] * step)
            self.outlined[i] = used.any(0)
            before = self.is_beside[i] if self.stage == NARROWEST else None
            self.is_beside[i] = beside_outline(log_share, max(OUTLINE[self.stage], BESIDE), before)
            self.used[i] = used & ~self.is_beside[i]
            if number == 0:
                inverse = np.where(self.used[i], 1.0 / scan.sigma, 0.0)
                mean = np.sum(np.exp(log_share)[:, None] * value, 0)
                self.linear[i] = linear_start(scan, mean, inverse, self.settings)
            modelled = np.stack([expected_counts(scan, self.linear[i], image) for image in value])
            self.member[i] = membership(scan, used, modelled, log_share, self.settings)
            image = np.sum(self.member[i][:, None] * value, 0)
            misfit = np.where(self.used[i], scan.counts - expected_counts(scan, self.linear[i], image), np.nan)
            scale = max(1.0, float(robust_std(misfit / scan.sigma)))
            self.weights[i] = np.nan_to_num(
                cauchy_weight(misfit / scan.sigma, self.settings.robust_limit * scale), nan=0.0
            )
            if number > 0 and not self.is_error_known:
                self._estimate_common_errors(i, seen, np.nan_to_num(misfit))
        self.is_error_known = self.is_near

    def _estimate_common_errors(self, i: int, seen: Seen, misfit: np.ndarray) -> None:
        """Estimate the errors of scan lines, and of tiles without them, from a misfit [detector, y, x], counts."""
        weight, lines = self.inverse(i) ** 2, self.line_groups[i]
        mean, total = group_means(misfit, weight, lines)
        self.lines[i] = common_std(mean, total)
        if not self.is_near:
            return
        variance = self.lines[i][:, None] ** 2
        share = variance * total / (1.0 + variance * total)  # of the mean that is the line's own
        self.tiles[i] = _tiles_of(seen)
        mean, total = group_means(misfit - lines.spread(share * mean), weight, self.tiles[i])
        self.model_error[i] = np.stack([common_std(mean[:, p::2], total[:, p::2], is_sure=True) for p in (0, 1)], 1)

    def _scattered_again(self, number: int, i: int, at: np.ndarray, seen: Seen, instrument: Instrument) -> Multiple:
        """Compute the multiple scattering of a scan, its derivatives anew where the unknowns have moved far."""
        scan, traced, plan = self.scans[i], None, None
        if np.max(np.abs(self.x - self.traced_at[i]) / self.deviation) < OLD:
            return self.multiple[i]
        if self.trace is not None:
            own = {name: float(v) for name, v in scan.model.object_of(at).items()}
            bright = np.exp(np.maximum(0.0, own["log albedo ratio"]))  # the tracer's brighter surface has the albedo 1
            albedo = np.where(seen.is_object, np.exp(own["log albedo ratio"]), 1.0) / bright
            thrift = 1 if self.is_near else THRIFT
            traced = self.trace(i, instrument, own, scan.model.raster, thrift) / albedo * bright
            if max(scan.model.raster.shape) <= MOST_SMOOTHED:
                plan = radiosity_plan(scan.model, at, self.settings.substrate_um)
                traced = smoothed_by(traced, radiosity_at(scan.model, at, plan), seen.is_object)
            self.traced_at[i] = self.x if self.is_near else self.traced_at[i]
        moved = np.abs(self.x - self.expanded_at[i]) / self.deviation
        if traced is not None and number >= len(RADIOSITY_PIXELS) and np.max(moved) < STALE:
            return self.multiple[i].shifted(traced, at)
        self.expanded_at[i] = self.x
        pixels = RADIOSITY_PIXELS[min(number, len(RADIOSITY_PIXELS) - 1)]
        about = self.settings.substrate_um, pixels, traced, plan
        return expand_multiple(scan.model, at, self.layout.free[i], *about)

    def fitted(self) -> Instrument:
        """Move the instrument by the present unknowns."""
        return moved_instrument(self.stated, self.layout.of_scan(0, self.x))


def _outline_pitch(scan: KnownScan) -> float:
    """Return the pitch that the outline's scale refers to [um]; at a finer one the fit would creep, not step."""
    return stride_for(scan, FIRST_PIXELS) * pitch(scan.model.raster.y)


def _tiles_of(seen: Seen) -> Groups:
    """Divide a scan into tiles; those of the object are apart from those of the substrate."""
    where = np.nonzero(seen.is_object)
    across = max((int(np.ptp(w)) + 1 for w in where if w.size), default=0)
    return tiles(seen.is_object, max(TILE, round(across / TILES_ACROSS)))


def fit_known_shapes(
    stacks: list[MicrographStack],
    known: list[KnownObject],
    settings: KnownShapeSettings,
    *,
    trace: Trace | None = None,
    report: Callable[[int, int, str], None] = lambda done, total, note: None,
) -> KnownFit:
    """Fit the instrument of scans of known objects.

    Args:
        stacks: measured counts, or simulated ones, of one instrument.
        known: the object of every scan.
        settings: priors and the fit.
        trace: traces multiple scattering; default: by radiosity alone.
        report: called before each round with (round, rounds, what is known).

    Raises:
        SceneError: the scans have different instruments, or a scan cannot be fitted.
        GuardError: nothing can be determined.
    """
    stated = one_instrument(stacks)
    scans = [prepare_scan(s, k, settings) for s, k in zip(stacks, known, strict=True)]
    if all(scan.known.kind == "flat" for scan in scans):
        raise GuardError(
            "a flat alone determines no direction of an aperture: calibrate with a ball, step or wedge, jointly "
            "with the flat if you wish"
        )
    for i, (scan, stack) in enumerate(zip(scans, stacks, strict=True)):
        if scan.known.kind != "flat":
            reach = 0.5 * float(max(np.ptp(stack.x), np.ptp(stack.y)))
            scans[i], _ = started(stated, scan, settings, reach)
    fit, rounds, is_converged = _Fit(stated, scans, settings, trace), 0, False
    strides = [stride_for(scan, FIRST_PIXELS) for scan in scans]
    if max(strides) > 1 and settings.max_rounds > 1:
        first = [thinned(scan, stride) for scan, stride in zip(scans, strides, strict=True)]
        coarse = _Fit(stated, first, settings, trace)
        rounds, _ = _run(coarse, settings.max_rounds // 2, rounds, report, until_near=True)
        fit.start_at(coarse)
    rounds, is_converged = _run(fit, settings.max_rounds, rounds, report)
    return _result(fit, rounds, is_converged)


def _run(
    fit: _Fit, max_rounds: int, done: int, report: Callable[[int, int, str], None], *, until_near: bool = False
) -> tuple[int, bool]:
    """Run the rounds of a fit until it has converged, or until it is near.

    Returns:
        Rounds so far, `done` of them before, and whether the fit has converged.
    """
    note = "start" if not done else "all pixels"
    for number in range(max_rounds - done):
        report(done + number, max_rounds, note)
        fit.update(number)
        solved = least_squares(
            fit.residuals,
            fit.joined(),
            fit.derivatives,  # type: ignore[arg-type]  # SciPy's stubs know texts only
            x_scale="jac",  # type: ignore[arg-type]
            max_nfev=_STEPS,
            xtol=1e-6,
            ftol=_FTOL[fit.is_near],
        )
        before = fit.x
        fit.x, fit.linear = fit.split(solved.x)
        jacobian = solved.jac
        fit.deviation = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))[: len(fit.x)]
        change = float(np.max(np.abs(fit.x - before) / fit.deviation))
        note = f"largest change {change:.2g} standard deviations, cost {2.0 * solved.cost:.5g}"
        is_at_minimum = number > 1 and solved.status > 0
        if is_at_minimum and fit.is_near and change < CONVERGED:
            return done + number + 1, True
        if is_at_minimum and change < SETTLED:
            fit.is_near |= fit.stage == NARROWEST
            fit.stage = min(fit.stage + 1, NARROWEST)
        if fit.is_near and until_near:
            return done + number + 1, False
    return max_rounds, False


def _result(fit: _Fit, rounds: int, is_converged: bool) -> KnownFit:
    """Evaluate the fit at its end: residuals, covariance, inflation."""
    z = fit.joined()
    jacobian, residual = fit.derivatives(z), fit.residuals(z)
    inverse = np.linalg.inv(jacobian.T @ jacobian)
    n_data = sum(scan.counts.size for scan in fit.scans)
    shapes, used = [scan.counts.shape for scan in fit.scans], zip(fit.weights, fit.used, strict=True)
    data = jacobian[:n_data], residual[:n_data], inverse
    chi_square, correlated = enlargement(shapes, [w[u] for w, u in used], *data, fit.settings.robust_limit)
    inflation = max(1.0, np.sqrt(chi_square), correlated)
    n = len(fit.x)
    # outlines and priors are no data: the residuals say nothing about them
    informed = jacobian[:n_data].T @ jacobian[:n_data] / inflation**2 + jacobian[n_data:].T @ jacobian[n_data:]
    covariance = np.linalg.inv(informed)
    std = np.sqrt(np.diag(covariance))
    prior, stated = fit.layout.priors, fit.layout.stated
    linear_covariance = []
    for first, size in zip(fit.offsets[:-1], fit.prior, strict=True):
        own = covariance[first : first + size.size, first : first + size.size].reshape(*size.shape, *size.shape)
        linear_covariance.append(np.einsum("kikj,ki,kj->kij", own, size, size))
    residuals, expected, seen = [], [], []
    for i, scan in enumerate(fit.scans):
        at = fit.layout.of_scan(i, fit.x)
        expected.append(expected_counts(scan, fit.linear[i], fit.image(i, fit.x)[0]))
        residuals.append(np.where(fit.used[i], (scan.counts - expected[-1]) / scan.sigma, np.nan))
        seen.append(see(scan.model, at))
    return KnownFit(
        fit.fitted(), fit.stated, fit.scans, fit.layout.names, fit.layout.units, stated, prior, stated + prior * fit.x,
        prior * std[:n], covariance[:n, :n], fit.layout.n_shared, fit.linear,
        linear_covariance,
        residuals, expected, fit.weights, seen, fit.lines, fit.model_error, chi_square, float(inflation), rounds,
        is_converged,
    )  # fmt: skip
