"""Agreement of a simulation with measured micrographs: residuals in standard errors, chi-square, causes of contrast.

Fits, for each detector, the gain, offset and slow drift that bring the simulation onto the measured counts on the same
raster (linear, robust), and judges the residuals. The offset is always fitted, never read from a dark region. Does not
simulate, and does not shift the sample, but estimates its shift.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import shift as shift_image
from scipy.optimize import minimize

from helio_jax.arrays import pitch, robust_std
from helio_jax.errors import GuardError
from helio_jax.micrograph import MicrographStack

OUTLIER = 3.0
"""Residuals beyond this many robust deviations weigh less (Huber), so that scratches do not set gain and offset."""
N_ITERATIONS = 6
"""Iterations of reweighting."""
REACH = 0.15
"""Largest shift of the sample that is searched, over the field."""
N_STEPS = 5
"""Steps of that search to either side."""
AGREES = 1.2
"""Chi-square per pixel up to which data and simulation agree within the noise."""
FLAGGED = 5.0
"""Robust deviations beyond which a pixel is flagged in any detector (scratches, dirt)."""


@dataclass(frozen=True)
class Terms:
    """Terms fitted beside the gain, for each detector.

    Attributes:
        offset: whether a constant background is fitted.
        drift: degree of the polynomial in scan time; 0: none.
        along: whether a slope along the fast axis is fitted.
        lag: response time of the detector in pixels (exponential, in scan order).
        gain_drift: degree of the gain's polynomial in scan time; 0: constant.
    """

    offset: bool = True
    drift: int = 3
    along: bool = True
    lag: float = 0.0
    gain_drift: int = 0

    def basis(self, shape: tuple[int, int], is_row_slow: bool) -> tuple[list[np.ndarray], np.ndarray]:
        """Return the background's images and the factors of the gain's drift [term, y, x]."""
        time, along = np.meshgrid(*(np.linspace(-1.0, 1.0, n) for n in shape), indexing="ij")
        if not is_row_slow:
            time, along = along, time
        degrees = np.moveaxis(np.polynomial.legendre.legvander(time, max(self.drift, self.gain_drift)), -1, 0)
        background = [*degrees[: int(self.offset)], *degrees[1 : self.drift + 1], *([along] if self.along else [])]
        return background, degrees[1 : self.gain_drift + 1]


def lagged(image: np.ndarray, pixels: float, is_row_slow: bool) -> np.ndarray:
    """Apply the exponential response of a detector, with a time constant of `pixels`, to an image [y, x].

    The scan is a raster with fly-back: every line starts settled on its first pixel.
    """
    if pixels <= 0.0:
        return image
    rows = image if is_row_slow else image.T
    keep, out = np.exp(-1.0 / pixels), rows.copy()
    for j in range(1, rows.shape[1]):
        out[:, j] = keep * out[:, j - 1] + (1.0 - keep) * rows[:, j]
    return out if is_row_slow else out.T


@dataclass(frozen=True)
class Agreement:
    """Measured data and normalised simulation.

    Attributes:
        detectors: names.
        gain: counts per detection probability [detector].
        offset: background [detector], counts (0 where none is fitted).
        model: the normalised simulation [detector, y, x], counts.
        residuals: (data - model) / standard error [detector, y, x], NaN where not observed.
        n_parameters: number of fitted parameters.
        shift: of the sample, relative to the scene (x, y) [um].
        gain_drift: coefficients of the gain's Legendre polynomials in scan time, from -1 to 1, over the mean gain
            [detector, degree].
    """

    detectors: tuple[str, ...]
    gain: np.ndarray
    offset: np.ndarray
    model: np.ndarray
    residuals: np.ndarray
    n_parameters: int
    shift: tuple[float, float]
    gain_drift: np.ndarray

    @property
    def is_flagged(self) -> np.ndarray:
        """Pixels whose residual is no noise or smooth model error in any detector: scratches, dirt, edges [y, x]."""
        spread = robust_std(self.residuals, (1, 2))
        return np.any(np.abs(np.nan_to_num(self.residuals)) > FLAGGED * np.maximum(spread, 1.0), axis=0)

    @property
    def chi2(self) -> np.ndarray:
        """Chi-square per pixel [detector]."""
        return np.nanmean(self.residuals**2, axis=(1, 2))

    @property
    def chi2_unflagged(self) -> np.ndarray:
        """The same outside flagged pixels [detector]."""
        return np.nanmean(np.where(self.is_flagged, np.nan, self.residuals) ** 2, axis=(1, 2))

    @property
    def n_data(self) -> int:
        """Observed pixels, all detectors."""
        return int(np.isfinite(self.residuals).sum())

    @property
    def bic(self) -> float:
        """Bayesian information criterion, with the noise as stated: chi-square + n_parameters ln(n_data).

        Source: Schwarz, Ann. Stat. 6 (1978) 461.
        """
        return float(np.nansum(self.residuals**2) + self.n_parameters * np.log(self.n_data))

    def verdict(self) -> str:
        """Return a sentence on the agreement of data and simulation."""
        total, clean = float(np.mean(self.chi2)), float(np.mean(self.chi2_unflagged))
        if total <= AGREES:
            return f"data and simulation agree within the noise: chi-square per pixel {total:.2f}"
        worst = self.detectors[int(np.argmax(self.chi2_unflagged))]
        found = "agree within the noise elsewhere" if clean <= AGREES else f"differ most in detector {worst!r}"
        return (
            f"data and simulation differ: chi-square per pixel {total:.2f}, {clean:.2f} outside the "
            f"{self.is_flagged.mean():.1%} of the pixels that are flagged; they {found}"
        )

    def as_dict(self) -> dict[str, object]:
        """Return a JSON-compatible summary."""
        each = zip(self.detectors, self.gain, self.offset, self.chi2, self.chi2_unflagged, strict=True)
        return {
            "verdict": self.verdict(),
            "chi2_per_pixel": float(np.mean(self.chi2)),
            "chi2_per_pixel_unflagged": float(np.mean(self.chi2_unflagged)),
            "flagged_share": float(self.is_flagged.mean()),
            "bic": self.bic,
            "n_data": self.n_data,
            "n_parameters": self.n_parameters,
            "shift_um": list(self.shift),
            "detectors": {
                name: {"gain": float(g), "offset": float(o), "chi2": float(c), "chi2_unflagged": float(u)}
                for name, g, o, c, u in each
            },
        }


def _fit(data: np.ndarray, std: np.ndarray, seen: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """Fit images [term, y, x] to one detector's data robustly (Huber weights); return their coefficients."""
    columns, target, scale = basis[:, seen].T, data[seen], std[seen]
    weight = np.ones(target.size)
    for _ in range(N_ITERATIONS):
        w = weight / scale
        coefficients = np.linalg.lstsq(columns * w[:, None], target * w, rcond=None)[0]
        misfit = np.abs(target - columns @ coefficients) / scale
        limit = OUTLIER * max(float(robust_std(misfit)), 1.0)
        weight = np.sqrt(np.minimum(1.0, limit / np.maximum(misfit, 1e-12)))
    return coefficients


def normalise(
    stack: MicrographStack,
    probability: np.ndarray,
    terms: Terms = Terms(),
    *,
    own_variance: np.ndarray | float = 0.0,
    shift: tuple[float, float] = (0.0, 0.0),
) -> Agreement:
    """Fit gain, offset and drift that bring simulated images onto measured ones.

    Args:
        stack: measured counts with their variance.
        probability: simulated detection probability per beam atom, same raster [detector, y, x].
        terms: fitted beside the gain.
        own_variance: of `probability`, from the simulation's noise [detector, y, x].
        shift: of the sample, copied to the result [um].

    Raises:
        GuardError: the noise of the data is not known, or a detector shows none of the simulated contrast.
    """
    if stack.variance is None:
        raise GuardError(
            f"{stack.name}: the variance of its counts is not known: no simulation can be compared with it"
        )
    is_row_slow = stack.fast_axis == "x"
    background, gain_changes = terms.basis(stack.shape[1:], is_row_slow)
    std = np.sqrt(np.maximum(stack.variance, 1e-300))
    model, gain, offset = np.empty(stack.shape), np.empty(stack.shape[0]), np.zeros(stack.shape[0])
    gain_drift = np.empty((stack.shape[0], terms.gain_drift))
    for k, image in enumerate(probability):
        signal = lagged(image, terms.lag, is_row_slow)
        images = np.stack([signal, *background, *(signal * gain_changes)])
        found = _fit(stack.counts[k], std[k], stack.is_observed[k], images)
        if not found[0] > 0.0:
            raise GuardError(
                f"detector {stack.instrument.detector_names[k]!r} does not show the simulated contrast (gain "
                f"{found[0]:g} counts): check the order of the detectors and the orientation of the image"
            )
        model[k] = np.tensordot(found, images, 1)
        gain[k], offset[k] = found[0], found[1] if terms.offset else 0.0
        gain_drift[k] = found[found.size - terms.gain_drift :] / found[0]
    std = np.sqrt(std**2 + gain[:, None, None] ** 2 * own_variance)
    residuals = np.where(stack.is_observed, (stack.counts - model) / std, np.nan)
    n = stack.shape[0] * (1 + len(background) + terms.gain_drift) + (terms.lag > 0.0)
    return Agreement(stack.instrument.detector_names, gain, offset, model, residuals, n, shift, gain_drift)


def find_shift(
    stack: MicrographStack, probability: np.ndarray, terms: Terms = Terms(), reach: float = REACH
) -> tuple[float, float]:
    """Find the shift (x, y) of the sample from its simulated place [um].

    Minimises the robust misfit of the shifted and normalised images, first on a grid over `reach` times the field.
    Beyond the simulated field the border is repeated, which is exact for a uniform border.
    """
    step = np.array([pitch(stack.y), pitch(stack.x)])
    size = max(2.0, reach * max(stack.shape[1:]))
    simplex = 0.5 * size / N_STEPS * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    if reach > 0.0:
        thin = max(1, max(stack.shape[1:]) // 48)
        offsets = size * np.arange(-N_STEPS, N_STEPS + 1) / N_STEPS
        starts = [np.array([i, j]) for i in offsets for j in offsets]
        part = _thinned(stack, thin)
        simplex += min(starts, key=lambda move: _misfit(part, probability, terms, move, thin))
    found = minimize(
        lambda move: _misfit(stack, probability, terms, move),
        simplex[0],
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-2, "maxfev": 80},
    )
    if not np.isfinite(found.fun):
        raise GuardError("the data do not show the simulated contrast at any shift: check detectors and orientation")
    y, x = found.x * step
    return float(x), float(y)


def _thinned(stack: MicrographStack, thin: int) -> MicrographStack:
    """Take every `thin`-th row and column of a stack."""
    every = np.s_[..., ::thin, ::thin]
    return MicrographStack(
        counts=stack.counts[every], x=stack.x[::thin], y=stack.y[::thin], instrument=stack.instrument,
        variance=None if stack.variance is None else stack.variance[every], is_observed=stack.is_observed[every],
        fast_axis=stack.fast_axis, name=stack.name,
    )  # fmt: skip


def _misfit(stack: MicrographStack, probability: np.ndarray, terms: Terms, move: np.ndarray, thin: int = 1) -> float:
    """Compute the robust misfit (Huber) of images shifted by `move` pixels [y, x] at every `thin`-th row and column."""
    moved = np.stack([shift_image(image, move, order=1, mode="nearest")[::thin, ::thin] for image in probability])
    try:
        r = np.abs(normalise(stack, moved, terms).residuals)
    except GuardError:
        return np.inf
    return float(np.nansum(np.where(r < OUTLIER, 0.5 * r**2, OUTLIER * (r - 0.5 * OUTLIER))))


def contrast_by_cause(unmasked: np.ndarray, single: np.ndarray, multiple: np.ndarray) -> Mapping[str, np.ndarray]:
    """Compute the contrast of each cause, as a fraction of the substrate's signal (median) [detector].

    Args:
        unmasked: probability of single scattering without masking [detector, y, x].
        single, multiple: the simulated probabilities [detector, y, x].
    """
    flat = np.median(single, axis=(1, 2))
    parts = {"single, nothing masked": unmasked, "lost to masks": unmasked - single, "multiple": multiple}
    return {name: image.std(axis=(1, 2)) / flat for name, image in parts.items()}
