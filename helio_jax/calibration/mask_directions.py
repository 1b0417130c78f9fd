"""Directions of the apertures by geometry alone: from the outline of what a ball hides on a flat.

Scans of balls are fitted by what they show whatever scattering law, gain and offset (`mask_model`). Unknowns, with the
priors of `KnownShapeSettings`: plate, beam and apertures, which all scans share; place and height of each ball, and the
substrate's tilt. The linear numbers are eliminated (variable projection). As in `known_shape`, weights are robust, data
of pixels close to the outline only tell on which side of it they lie, and residuals may be correlated within tiles.

Sources: Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413; Kaufman, BIT 15 (1975) 49.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import least_squares

from helio_jax.arrays import pitch, robust_std
from helio_jax.calibration.common_errors import enlargement
from helio_jax.calibration.known_model import see
from helio_jax.calibration.known_objects import KnownObject
from helio_jax.calibration.known_pixels import CONVERGED, NARROWEST, OUTLINE, beside_outline, membership, near_foot
from helio_jax.calibration.known_scan import (
    InstrumentFit,
    KnownScan,
    Layout,
    moved_instrument,
    one_instrument,
    prepare_scan,
)
from helio_jax.calibration.known_start import started
from helio_jax.calibration.mask_model import (
    N_COLUMNS,
    N_LEVEL,
    N_SCATTERED,
    MaskModel,
    columns,
    directions,
    parts_of,
    reading_derivative,
)
from helio_jax.calibration.unknowns import KnownShapeSettings, instrument_unknowns
from helio_jax.errors import GuardError
from helio_jax.instrument import Instrument, Uncertainty
from helio_jax.micrograph import MicrographStack
from helio_jax.robust import cauchy_weight

_WEAK = 10.0
"""Prior standard deviation of levels and brightness, in units of the substrate's signal."""
_STEPS, _TOLERANCE = 15, 1e-5
"""Steps of a round, and relative change of the cost at which it ends."""


@dataclass(frozen=True)
class MaskFit(InstrumentFit):
    """Result of the fit.

    Attributes (those of `InstrumentFit`, and):
        directions, direction_stds, direction_priors: polar angle and azimuth of the apertures as the spot sees them,
            their standard deviations after and before the fit [detector, 2], rad; `stated_directions`: as given.
        residuals: in standard deviations, NaN where not used [detector, y, x], per scan.
        expected: readings [detector, y, x], per scan.
        visible: share of every aperture that the substrate sees, NaN on the ball [detector, y, x], per scan.
        chi_square: mean square of the weighted residuals over their expected one.
        inflation: by which the standard deviations were enlarged for misfit and correlated residuals.
        rounds, is_converged: of the fit.
    """

    directions: np.ndarray
    direction_stds: np.ndarray
    direction_priors: np.ndarray
    stated_directions: np.ndarray
    residuals: list[np.ndarray]
    expected: list[np.ndarray]
    visible: list[np.ndarray]
    chi_square: float
    inflation: float
    rounds: int
    is_converged: bool


class _Solved(NamedTuple):
    """The linear numbers of a scan at given unknowns.

    Attributes:
        linear: amplitudes of the columns of `mask_model` and of the read-out [detector, column].
        design: of each detector, times weights and prior standard deviations [detector, pixel, column].
        factor: Cholesky factors of the normal equations [detector].
        outline: residuals of the outline [y, x].
        expected: readings [detector, y, x].
    """

    linear: np.ndarray
    design: list[np.ndarray]
    factor: list
    outline: np.ndarray
    expected: np.ndarray


class _Scan:
    """One scan at the present weights and membership."""

    def __init__(self, scan: KnownScan) -> None:
        self.scan, self.model = scan, MaskModel(scan.model)
        self.step = pitch(scan.model.raster.y)
        self.used = scan.is_used
        self.width = OUTLINE[0] * self.step
        self.weight = np.ones(scan.counts.shape)
        self.outlined = scan.is_used.any(0)
        self.is_beside = np.zeros(self.outlined.shape, bool)
        self.member = np.zeros((2, *self.outlined.shape))
        signal = np.abs(scan.signal)[:, None]
        known = np.concatenate([np.full(N_COLUMNS, _WEAK), scan.columns.priors])
        self.prior = signal * known
        # the mean offset is free
        self.prior[:, N_COLUMNS] += np.abs(scan.counts).max((1, 2))

    def inverse(self) -> np.ndarray:
        """Compute the weights of the data over their noise."""
        return np.where(self.used, np.sqrt(self.weight) / self.scan.sigma, 0.0)

    def solve(self, at: np.ndarray) -> _Solved:
        """Solve for the linear numbers at the unknowns of the scan."""
        visible, every, log_share = columns(self.model, at, self.width)
        first = N_LEVEL + N_SCATTERED
        linear, design, factors, expected = [], [], [], []
        for k, (counts, inverse) in enumerate(zip(self.scan.counts, self.inverse(), strict=True)):
            flat = np.concatenate([every[:N_LEVEL] * visible[k], every[N_LEVEL:first]]) * self.member[1]
            own = np.concatenate([flat, every[first:] * self.member[0], self.scan.columns.modes])
            rows = own.reshape(len(own), -1).T * (inverse.reshape(-1, 1) * self.prior[k])
            factor = cho_factor(rows.T @ rows + np.eye(len(own)))
            found = self.prior[k] * cho_solve(factor, rows.T @ (counts * inverse).ravel())
            design.append(rows)
            factors.append(factor)
            linear.append(found)
            expected.append(np.tensordot(found, own, 1))
        misfit = np.maximum(-np.sum(self.member * log_share, 0), 0.0)
        outline = np.sqrt(2.0 * misfit) * self.outlined
        return _Solved(np.array(linear), design, factors, outline, np.array(expected))

    def residuals(self, solved: _Solved) -> tuple[np.ndarray, np.ndarray]:
        """Compute the residuals of data [detector, y, x] and outline [y, x]."""
        return (solved.expected - self.scan.counts) * self.inverse(), solved.outline

    def derivatives(self, at: np.ndarray, free: np.ndarray, solved: _Solved) -> tuple[np.ndarray, np.ndarray]:
        """Compute the derivatives of both by the free unknowns, the linear numbers following [free unknown, ...]."""
        linear = solved.linear[:, :N_COLUMNS]
        slopes, outline = reading_derivative(self.model, at, self.width, self.member, linear, free)
        slopes = slopes * self.inverse()
        out = np.empty(slopes.shape)
        for k, (rows, factor) in enumerate(zip(solved.design, solved.factor, strict=True)):
            own = slopes[:, k].reshape(len(free), -1).T
            out[:, k] = (own - rows @ cho_solve(factor, rows.T @ own)).T.reshape(slopes[:, k].shape)
        return out, outline * self.outlined

    def update(self, at: np.ndarray, number: int, settings: KnownShapeSettings) -> None:
        """Compute the width of the outline, on which part every pixel lies, and weights, at the present unknowns."""
        wide, scan = OUTLINE[0] * self.step, self.scan
        own = {name: float(v) for name, v in scan.model.object_of(at).items()}
        used = scan.is_used & ~near_foot(scan, own, see(scan.model, at).distance, settings)
        self.outlined = used.any(0)
        stage = min(number, NARROWEST)
        self.width = OUTLINE[stage] * self.step
        visible, every, log_share = columns(self.model, at, wide)
        self.is_beside = beside_outline(log_share, OUTLINE[stage], self.is_beside if number > NARROWEST else None)
        self.used = used & ~self.is_beside
        if number == 0:
            self.member = np.exp(log_share)
        linear = self.solve(at).linear
        offset = np.tensordot(linear[:, N_COLUMNS:], scan.columns.modes, 1)
        modelled = np.stack(parts_of(visible, every, linear[:, :N_COLUMNS])) + offset
        self.member = membership(scan, used, modelled, log_share, settings)
        misfit = scan.counts - np.sum(self.member[:, None] * modelled, 0)
        misfit = np.where(self.used, misfit / scan.sigma, np.nan)
        scale = max(1.0, float(robust_std(misfit)))
        self.weight = np.nan_to_num(cauchy_weight(misfit, settings.robust_limit * scale), nan=0.0)


def fit_masks(
    stacks: list[MicrographStack],
    known: list[KnownObject],
    settings: KnownShapeSettings,
    *,
    report: Callable[[int, int, str], None] = lambda done, total, note: None,
) -> MaskFit:
    """Fit the directions of the apertures to scans of balls on flats, by the outlines of ball and masks alone.

    Priors are those of `settings`, whatever the instrument file states as uncertain, so that an instrument that was
    found otherwise can be checked by it.

    Args:
        stacks: measured counts, or simulated ones, of one instrument.
        known: the ball of every scan.
        settings: priors and the fit; albedo, scattering law and multiple scattering are not in the model.
        report: called before each round with (round, rounds, what is known).

    Raises:
        SceneError: the scans have different instruments, or a scan cannot be fitted.
        GuardError: an object is no ball.
    """
    stated = one_instrument(stacks)
    for stack, item in zip(stacks, known, strict=True):
        if item.kind != "ball":
            raise GuardError(
                f"{stack.name}: directions by masks need a ball, got a {item.kind}: the mask of a straight edge "
                "tells one component of a direction only; leave out --masks"
            )
    settings = settings.changed(exponent=0.0, albedo=0.0, multiple=0.0)
    free = stated.model_copy(update={"uncertainty": Uncertainty(), "covariance": None})
    scans = []
    for stack, item in zip(stacks, known, strict=True):
        reach = 0.5 * float(max(np.ptp(stack.x), np.ptp(stack.y)))
        scans.append(started(free, prepare_scan(stack, item, settings), settings, reach)[0])
    layout = Layout(instrument_unknowns(free, settings), scans)
    fit = _Fit([_Scan(scan) for scan in scans], layout)
    x, deviation, is_converged, rounds, note = np.zeros(len(layout.unknowns)), 1.0, False, 0, "start"
    while rounds < settings.max_rounds and not is_converged:
        report(rounds, settings.max_rounds, note)
        fit.update(x, rounds, settings)
        solved = least_squares(
            fit.residuals,
            x,
            fit.derivatives,  # type: ignore[arg-type]  # SciPy's stubs know texts only
            max_nfev=_STEPS,
            xtol=1e-6,
            ftol=_TOLERANCE,
        )
        deviation = np.sqrt(np.diag(np.linalg.inv(solved.jac.T @ solved.jac)))
        change = float(np.max(np.abs(solved.x - x) / deviation))
        x, rounds = solved.x, rounds + 1
        note = f"largest change {change:.2g} standard deviations, cost {2.0 * solved.cost:.5g}"
        is_converged = rounds > len(OUTLINE) and change < CONVERGED
    return _result(fit, stated, x, settings, rounds, is_converged)


class _Fit:
    """All scans, and the unknowns' layout; the linear numbers at the last unknowns are kept."""

    def __init__(self, scans: list[_Scan], layout: Layout) -> None:
        self.scans, self.layout = scans, layout
        self._last: tuple[np.ndarray, list[_Solved]] | None = None

    def update(self, x: np.ndarray, number: int, settings: KnownShapeSettings) -> None:
        """Update every scan."""
        for i, scan in enumerate(self.scans):
            scan.update(self.layout.of_scan(i, x), number, settings)
        self._last = None

    def solved(self, x: np.ndarray) -> list[_Solved]:
        """Solve for the linear numbers of all scans."""
        if self._last is None or not np.array_equal(self._last[0], x):
            self._last = x.copy(), [scan.solve(self.layout.of_scan(i, x)) for i, scan in enumerate(self.scans)]
        return self._last[1]

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Compute all residuals: of the data of all scans, of their outlines, and the priors."""
        pairs = [scan.residuals(solved) for scan, solved in zip(self.scans, self.solved(x), strict=True)]
        return np.concatenate([*(data.ravel() for data, _ in pairs), *(line.ravel() for _, line in pairs), x])

    def derivatives(self, x: np.ndarray) -> np.ndarray:
        """Compute the derivatives of the residuals [residual, unknown]."""
        data, lines = [], []
        for i, (scan, solved) in enumerate(zip(self.scans, self.solved(x), strict=True)):
            place, free = self.layout.place[i], self.layout.free[i]
            found = scan.derivatives(self.layout.of_scan(i, x), free, solved)
            for out, images in zip((data, lines), found, strict=True):
                rows = np.zeros((images[0].size, len(x)))
                rows[:, place] = images.reshape(len(free), -1).T * self.layout.scale[place]
                out.append(rows)
        return np.concatenate([*data, *lines, np.eye(len(x))])


def _result(
    fit: _Fit, stated: Instrument, x: np.ndarray, settings: KnownShapeSettings, rounds: int, is_converged: bool
) -> MaskFit:
    """Evaluate the fit at its end: residuals, covariance, directions."""
    jacobian, residual, layout = fit.derivatives(x), fit.residuals(x), fit.layout
    scans = [scan.scan for scan in fit.scans]
    n_data = sum(scan.counts.size for scan in scans)
    inverse = np.linalg.inv(jacobian.T @ jacobian)
    chi_square, correlated = enlargement(
        [scan.counts.shape for scan in scans],
        [scan.weight[scan.used] for scan in fit.scans],
        jacobian[:n_data],
        residual[:n_data],
        inverse,
        settings.robust_limit,
    )
    inflation = max(1.0, np.sqrt(chi_square), correlated)
    # outlines and priors are no data: the residuals say nothing about them
    informed = jacobian[:n_data].T @ jacobian[:n_data] / inflation**2 + jacobian[n_data:].T @ jacobian[n_data:]
    covariance = np.linalg.inv(informed)
    at, free, place = layout.of_scan(0, x), layout.free[0], layout.place[0]
    found, slopes = directions(fit.scans[0].model, at)
    ways = slopes[..., free] * layout.scale[place]
    own = covariance[np.ix_(place, place)]
    prior, given = layout.priors, layout.stated
    residuals, expected, visible = [], [], []
    for i, (scan, solved) in enumerate(zip(fit.scans, fit.solved(x), strict=True)):
        share, _, log_share = columns(scan.model, layout.of_scan(i, x), 0.0)
        visible.append(np.where(log_share[1] > log_share[0], share, np.nan))
        expected.append(solved.expected)
        misfit = (scan.scan.counts - solved.expected) / scan.scan.sigma
        residuals.append(np.where(scan.used, misfit, np.nan))
    return MaskFit(
        moved_instrument(stated, at), stated, scans, layout.names, layout.units, given, prior, given + prior * x,
        prior * np.sqrt(np.diag(covariance)), covariance, layout.n_shared,
        found, np.sqrt(np.einsum("kai,ij,kaj->ka", ways, own, ways)), np.sqrt(np.sum(ways**2, -1)),
        directions(fit.scans[0].model, layout.start[0])[0],
        residuals, expected, visible, chi_square, float(inflation), rounds, is_converged,
    )  # fmt: skip
