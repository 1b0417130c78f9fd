"""The photometric methods: normals of every pixel from the data, heights by integration, both at the current height.

linear: detection directions of the substrate (the published method). nearfield: those of the heights found so far;
masking and multiple scattering predicted on the result are subtracted from the data, once: more iterations help little,
and oscillate where one of three detectors is masked. RMS errors without and with it: own spheres A and B 4.0, 1.8 % and
6.0, 5.3 %, measured sphere A 10.8, 8.7 % (121 x 121). Error bars: noise, calibration and the misfit of the traced map,
drawn (`bootstrap`), and two common-mode errors, of unknown sign: the change by a further correction, and what slopes
that the data contradict add up to (`misfit_errors`). Rotated scans come corrected, from their calibration.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from helio_jax.arrays import border_mask, robust_std
from helio_jax.errors import PredictionError
from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.render import Corrections
from helio_jax.forward.surface import slopes_of_normal
from helio_jax.geometry_prior import GeometryPrior
from helio_jax.inverse.bootstrap import SEED, bootstrap_heights, rescale_to_border, unmodelled_signal
from helio_jax.inverse.integrate import integrate_slopes
from helio_jax.inverse.linear import MIN_IMAGES, PhotometricSolution, signal_of, solve_linear
from helio_jax.inverse.misfit_errors import flag_floating, path_error
from helio_jax.inverse.quality import reasons_from_data
from helio_jax.inverse.samples import add_common_modes
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.verdict import Misfit, expected_chi_square
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction

Predict = Callable[[np.ndarray, np.ndarray], Corrections]
"""(heights [y, x] um, unit normals [y, x, 3]) -> masks and multiple scattering."""
_UNPREDICTED = "masks and multiple scattering could not be predicted"


def level(height: np.ndarray, settings: ReconstructSettings, weight: np.ndarray) -> np.ndarray:
    """Subtract the plane (flat border) or the median (free border) fitted to the border's known pixels."""
    rows, columns = np.nonzero(border_mask(height.shape, settings.border_fraction) & (weight > 0))
    if rows.size < 3:
        return height - np.median(height)
    if settings.border == "free":
        return height - np.median(height[rows, columns])
    basis = np.stack([np.ones(rows.size), rows / height.shape[0], columns / height.shape[1]], -1)
    keep = np.ones(rows.size, bool)
    for _ in range(3):
        plane = np.linalg.lstsq(basis[keep], height[rows, columns][keep], rcond=None)[0]
        misfit = np.abs(height[rows, columns] - basis @ plane)
        keep = misfit <= 3.0 * max(robust_std(misfit), 1e-9)
    i, j = np.mgrid[: height.shape[0], : height.shape[1]]
    return height - (plane[0] + plane[1] * i / height.shape[0] + plane[2] * j / height.shape[1])


def _integrate(
    solution: PhotometricSolution, shift: np.ndarray, raster: Raster, settings: ReconstructSettings
) -> np.ndarray:
    a, b, is_facing = slopes_of_normal(solution.normals, shift)
    weight = solution.weight * np.where(is_facing, 1.0, 0.1)
    if settings.integrator in ("dct_poisson", "harker_oleary"):
        weight = (weight > 0).astype(float)
    return level(integrate_slopes(a, b, raster.dx, raster.dy, settings.integrator, weight), settings, weight)


def solve_nearfield(
    signal: np.ndarray,
    variance: np.ndarray,
    optics: Optics,
    raster: Raster,
    settings: ReconstructSettings,
    iterations: int,
) -> tuple[np.ndarray, PhotometricSolution]:
    """Alternate between the photometric solution at the current height and its integration.

    One iteration is the linear method: directions of the substrate everywhere.

    Args:
        signal, variance: data in units of the beam [detector, y, x], NaN where not observed.
        optics, raster: of the scan.
        settings: integrator, border, damping.
        iterations: photometric solutions.
    """
    height = np.zeros(signal.shape[1:])
    for number in range(iterations):
        solution = solve_linear(signal, variance, form_factor(optics, limited(height, optics)))
        new = _integrate(solution, optics.beam_shift, raster, settings)
        height = new if number == 0 else height + settings.damping * (new - height)
    return height, solution


def limited(height: np.ndarray, optics: Optics) -> np.ndarray:
    """Clip heights between half a plate distance below the substrate and 90 % of it above.

    Only the directions are taken there, so that a wild intermediate height cannot pass through the plate.
    """
    d = float(optics.sample_distance)
    return np.clip(height, -0.5 * d, 0.9 * d)


@dataclass(frozen=True)
class _Solver:
    """A photometric method on the data of one stack.

    Attributes:
        stack, settings: as in `photometric_heights`.
        optics: as stated.
        signal, variance: data in units of the beam [detector, y, x].
    """

    stack: MicrographStack
    settings: ReconstructSettings
    optics: Optics
    signal: np.ndarray
    variance: np.ndarray

    @classmethod
    def of(cls, stack: MicrographStack, settings: ReconstructSettings) -> "_Solver":
        return cls(stack, settings, Optics.of(stack.instrument), *signal_of(stack))

    @property
    def iterations(self) -> int:
        """Photometric solutions."""
        return 1 if self.settings.method == "linear" else self.settings.rounds

    @property
    def n_corrections(self) -> int:
        """How often predicted masks and multiple scattering are subtracted from the data."""
        return 0 if self.stack.is_without_multiple or self.settings.method == "linear" else self.settings.corrections

    def solve(self, data, variance, optics, stride=1) -> tuple[np.ndarray, PhotometricSolution]:
        """Solve for heights [y, x], um, by data of every `stride`-th pixel."""
        raster = Raster.of(self.stack)
        thinned = Raster.regular(data.shape[1:], stride * raster.dx, stride * raster.dy)
        return solve_nearfield(data, variance, optics, thinned, self.settings, self.iterations)

    def height_of(self, data: np.ndarray) -> np.ndarray:
        """Solve for heights by other data [y, x], um."""
        return self.solve(rescale_to_border(data, self.signal, self.settings), self.variance, self.optics)[0]

    def unmodelled(self, height: np.ndarray, solution: PhotometricSolution, predict: Predict) -> np.ndarray:
        """Predict the signal that the method does not model [detector, y, x]."""
        near = limited(height, self.optics)
        found = predict(near, solution.normals)
        multiple = (
            self.settings.refine.multiple_error * found.multiple if self.stack.is_without_multiple else found.multiple
        )
        phi = form_factor(self.optics, near)
        used = form_factor(self.optics, np.zeros_like(near)) if self.iterations == 1 else phi
        return unmodelled_signal(solution, used, phi, Corrections(found.masked, multiple))


def photometric_heights(
    stack: MicrographStack,
    settings: ReconstructSettings,
    predict: Predict | None = None,
    judge: Callable[[Reconstruction], tuple[Reconstruction, Misfit | None]] | None = None,
) -> Reconstruction:
    """Reconstruct heights by the method that the settings name, linear or nearfield, with error bars.

    Args:
        stack: three or more images of one scan.
        settings: method and options.
        predict: masks and multiple scattering of a surface (heights, normals); None: no corrections, no error bars.
        judge: tests the heights against the data; error bars include what the misfit shows.
    """
    solver = _Solver.of(stack, settings)
    data, subtracted = solver.signal, np.zeros(stack.counts.shape)
    height, solution = solver.solve(data, solver.variance, solver.optics)
    failure = ""
    try:
        for _ in range(solver.n_corrections if predict else 0):
            subtracted = solver.unmodelled(height, solution, predict)  # type: ignore[arg-type]
            data = rescale_to_border(solver.signal - subtracted, solver.signal, settings)
            height, solution = solver.solve(data, solver.variance, solver.optics)
    except PredictionError as error:
        failure = f"{_UNPREDICTED}: {error}"
    rec = _without_error_bars(solver, height, solution)
    rec, misfit = judge(rec) if judge else (rec, None)
    if predict is None or not settings.samples:
        return rec
    modes = []
    try:
        rest = solver.unmodelled(height, solution, predict) - subtracted
        modes.append(solver.height_of(data - rest if solver.n_corrections else data + rest) - height)
    except PredictionError as error:
        failure = failure or f"{_UNPREDICTED}: {error}"
    if misfit is not None:
        assert rec.chi_square is not None
        expected = expected_chi_square(stack, rec.instrument, rec.chi_square)
        modes.append(path_error(rec, misfit, Raster.of(stack), expected, settings))
    if not modes:
        return rec.replace(warnings=(*rec.warnings, f"no error bars: {failure}"))
    known = solver.optics, GeometryPrior.of(stack.instrument), settings
    difference = None if misfit is None else misfit.difference
    discrepancy = stack.instrument.uncertainty.discrepancy
    samples = bootstrap_heights(
        data, solver.variance, *known, lambda *drawn: solver.solve(*drawn)[0], difference, discrepancy
    )
    samples = add_common_modes(samples, modes, SEED + 1)
    std = np.sqrt(np.mean(samples**2, axis=0))
    rec = rec.replace(height_samples=samples, height_std=std, warnings=(*rec.warnings, *filter(None, [failure])))
    return rec if misfit is None else flag_floating(rec)


def _without_error_bars(solver: _Solver, height: np.ndarray, solution: PhotometricSolution) -> Reconstruction:
    """Make the result of a solution."""
    stack, settings = solver.stack, solver.settings
    reason = reasons_from_data(stack)
    n_few = int(np.sum(stack.is_observed.sum(0) < MIN_IMAGES))
    few = f"{n_few} pixels in fewer than {MIN_IMAGES} images took the substrate's normal"
    return Reconstruction(
        height=height,
        raster_x=stack.x,
        raster_y=stack.y,
        instrument=stack.instrument,
        method=settings.method,
        normals=solution.normals,
        albedo=np.where(np.isfinite(solution.albedo), solution.albedo, 0.0),
        is_valid=reason == 0,
        reason=reason,
        residuals=solution.residuals,
        border=settings.border,
        status=f"solved in {solver.iterations} iteration(s); {few}",
        provenance={"stack": dict(stack.provenance), "reconstruct": settings.model_dump(mode="json")},
    )
