"""Two studies of repeated noise: how near the fit comes to the Cramer-Rao bound, and how honest its error bars are.

Rows 3 and 4 of benchmarks/reconstruction.py. Surfaces are sums of plane waves and bumps, given by formulas, on a
raster; counts come from their exact slopes and the *tracer's* form factor, which shares no kernel with the fit. No
masks, no multiple scattering. Realisations run in batches, each written when done: a killed study goes on there.
The fits are shown nothing of the truth; priors that a case states are where its gains and offsets are drawn from.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.fft import dctn, idct

from helio_jax.arrays import border_mask
from helio_jax.forward.render import Corrections
from helio_jax.forward.surface import normal_of_slopes
from helio_jax.instrument import Instrument
from helio_jax.inverse.methods import reconstruct_stack
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction
from helio_jax.trace.direct import form_factors

if TYPE_CHECKING:
    from benchmarks.reconstruction import Record

PITCH_UM = 40.0
BANDS = ("piston", "tilt", "bowl", "mid", "fine")
"""Cosine modes by rank: (0, 0); the two of rank 1; the three of rank 2; below and above half of Nyquist's frequency."""
COLUMNS = ("n", "mean", "mean_square", "coverage_1", "coverage_2")
"""What is kept of the pulls of one realisation."""


class Relief(NamedTuple):
    """Heights [y, x], um, and beam-frame slopes dh/dX, dh/dY [y, x], exact."""

    height: np.ndarray
    slope_x: np.ndarray
    slope_y: np.ndarray

    def plus(self, other: "Relief") -> "Relief":
        """Return the sum of two reliefs."""
        return Relief(*(a + b for a, b in zip(self, other, strict=True)))

    def times(self, other: "Relief") -> "Relief":
        """Return the product of two reliefs, e.g. one of them an envelope (product rule)."""
        (h, a, b), (g, c, d) = self, other
        return Relief(h * g, a * g + h * c, b * g + h * d)


def raster(n: int) -> np.ndarray:
    """Return the beam positions of a row or column of `n` pixels about 0, um."""
    return (np.arange(n) - (n - 1) / 2) * PITCH_UM


def bump(axis: np.ndarray, height: float, width: float, center: tuple[float, float] = (0.0, 0.0)) -> Relief:
    """Return a Gaussian bump on the square raster; height, width (standard deviation) and centre (x, y) in um."""
    x, y = np.meshgrid(axis - center[0], axis - center[1])
    h = height * np.exp(-(x**2 + y**2) / (2 * width**2))
    return Relief(h, -h * x / width**2, -h * y / width**2)


def random_waves(axis: np.ndarray, seed: int, rms_slope: float, shortest: float, n_waves: int = 40) -> Relief:
    """Return plane waves of random direction, phase and frequency (uniform in the disc) with this rms slope.

    Args:
        axis: beam positions, um.
        seed: of the surface.
        rms_slope: of the gradient's length, averaged over phases.
        shortest: shortest period, um.
        n_waves: number of waves, each with the same slope.
    """
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(axis, axis)
    k = 2 * np.pi / shortest * np.sqrt(rng.uniform(0.02, 1.0, n_waves))
    angle, phase = rng.uniform(0, 2 * np.pi, (2, n_waves))
    total = Relief(*(np.zeros_like(x) for _ in range(3)))
    for size, direction, start in zip(k, angle, phase, strict=True):
        kx, ky = size * np.cos(direction), size * np.sin(direction)
        amplitude = rms_slope * np.sqrt(2.0 / n_waves) / size
        h, slope = amplitude * np.cos(kx * x + ky * y + start), -amplitude * np.sin(kx * x + ky * y + start)
        total = total.plus(Relief(h, kx * slope, ky * slope))
    return total


def expected_signal(instrument: Instrument, relief: Relief) -> np.ndarray:
    """Return the detection probability of every pixel [detector, y, x]: n . Phi with the tracer's form factor."""
    points = np.stack(np.broadcast_arrays(*instrument.spot_position(relief.height)), -1)
    phi = form_factors(instrument, points.reshape(-1, 3)).reshape(-1, *points.shape)
    normal = np.stack(normal_of_slopes(relief.slope_x, relief.slope_y, instrument.beam_shift), -1)
    return np.einsum("kyxi,yxi->kyx", phi, normal / np.linalg.norm(normal, axis=-1, keepdims=True))


def band_of_modes(shape: tuple[int, int]) -> np.ndarray:
    """Return the index into `BANDS` of every cosine mode [ky, kx]."""
    k, m = np.ogrid[: shape[0], : shape[1]]
    is_fine = np.maximum(k / shape[0], m / shape[1]) >= 0.5
    return np.where(k + m < 3, k + m, np.where(is_fine, 4, 3))


def fit(counts: np.ndarray, variance: np.ndarray, instrument: Instrument, settings: ReconstructSettings, n_rays: float):
    """Reconstruct counts [detector, y, x] by `refine`, told that nothing is masked or multiply scattered."""
    nothing = Corrections.none(counts.shape)
    axis = raster(counts.shape[1])
    stack = MicrographStack(counts, axis, axis, instrument, variance=variance, n_rays=n_rays)
    return reconstruct_stack(stack, settings, lambda _: lambda *surface, **known: nothing)


def batches(n: int, size: int) -> Iterator[range]:
    """Return the realisations 0 .. n - 1 in batches."""
    return (range(start, min(start + size, n)) for start in range(0, n, size))


# Row 3 -----------------------------------------------------------------------------------------------------------


def cosine_basis(n: int, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the orthonormal cosine modes at the pixels, and their exact derivatives [1/um], both [pixel, mode]."""
    modes = idct(np.eye(n), norm="ortho", axis=0)
    frequency = np.pi * np.arange(n) / (n * step)
    scale = np.where(np.arange(n) == 0, np.sqrt(1 / n), np.sqrt(2 / n))
    position = (np.arange(n) + 0.5) * step
    return np.asarray(modes), -scale * frequency * np.sin(np.outer(position, frequency))


def cramer_rao(instrument: Instrument, relief: Relief, sigma: np.ndarray, step: float) -> np.ndarray:
    """Return the Cramer-Rao bound of the variance of every cosine coefficient of the heights [ky, kx], um^2.

    For surfaces that are any cosine series of the raster (as many unknown coefficients as pixels, no prior): a slope is
    the exact derivative of the series. Gain, offset and albedo known; the piston is unknown like every other mode
    and bounded by the near field. Leaving out mode (0, 0) removes it: the bound of the piston-free root mean
    square is sqrt(sum of the rest / pixels). Dense: up to 64 x 64. Knows nothing of the fit.

    Args:
        instrument: of the scan.
        relief: true surface.
        sigma: standard deviation of the detection probabilities [detector, y, x].
        step: pitch, um.
    """
    by = []
    for i, h in enumerate((1.0, 1e-4, 1e-4)):
        up, down = ([*relief] for _ in range(2))
        up[i], down[i] = up[i] + h, down[i] - h
        by.append((expected_signal(instrument, Relief(*up)) - expected_signal(instrument, Relief(*down))) / (2 * h))
    (modes_y, slopes_y), (modes_x, slopes_x) = (cosine_basis(n, step) for n in relief.height.shape)
    bases = np.kron(modes_y, modes_x), np.kron(modes_y, slopes_x), np.kron(slopes_y, modes_x)
    information = np.zeros((relief.height.size,) * 2)
    for k, deviation in enumerate(sigma):
        parts = [(d[k] / deviation).reshape(-1, 1) * basis for d, basis in zip(by, bases, strict=True)]
        jacobian = np.sum(parts, axis=0)
        information += jacobian.T @ jacobian
    return np.diag(np.linalg.inv(information)).reshape(relief.height.shape)


@dataclass(frozen=True)
class Efficiency:
    """Row 3: errors of the fit against the bound.

    A new surface in every batch; gains and offsets known, border free, Gaussian noise of the variance
    that Poisson counts would have.
    """

    instrument: Instrument
    size: int = 48
    per_batch: int = 10
    rms_slope: float = 0.07
    shortest_um: float = 400.0
    snr: float = 30.0

    @property
    def settings(self) -> ReconstructSettings:
        """No prior that matters: instrument known, border free."""
        known = {"gain_std": 1e-6, "offset_std": 1e-6, "multiple_error": 1e-6}
        return ReconstructSettings.model_validate({"border": "free", "refine": {"samples": 64, **known}})

    def batch(self, realisations: range) -> dict[str, Any]:
        """Fit some realisations on one surface; return mean squares over pixels, um^2, without piston.

        Returns:
            `bound`, and per realisation `error`, `stated`: the bands' contributions [band], piston included as the
            first; `mean_error`: of the mean error over the batch, `valid`: share of valid pixels.
        """
        seed = realisations.start // self.per_batch
        relief = random_waves(raster(self.size), seed, self.rms_slope, self.shortest_um)
        signal = expected_signal(self.instrument, relief)
        n_rays = self.snr**2 / float(np.median(signal))
        sigma = np.sqrt(signal / n_rays)
        band = band_of_modes(relief.height.shape)

        def by_band(power: np.ndarray) -> list[float]:
            return (np.bincount(band.ravel(), power.ravel(), len(BANDS)) / power.size).tolist()

        out: dict[str, Any] = {
            "bound": by_band(cramer_rao(self.instrument, relief, sigma, PITCH_UM)),
            "error": [],
            "stated": [],
            "valid": [],
        }
        errors = []
        for i in realisations:
            noise = np.random.default_rng([3, i]).standard_normal(signal.shape)
            counts = n_rays * (signal + sigma * noise)
            rec = fit(counts, (n_rays * sigma) ** 2, self.instrument, self.settings, n_rays)
            errors.append(modes_of(rec.height - relief.height))
            out["error"].append(by_band(errors[-1] ** 2))
            out["stated"].append(by_band(np.mean(modes_of(samples_of(rec)) ** 2, axis=0)))
            out["valid"].append(float(rec.is_valid.mean()))
        return out | {"mean_error": by_band(np.mean(errors, axis=0) ** 2)}


def modes_of(field: np.ndarray) -> np.ndarray:
    """Return the orthonormal cosine coefficients [..., ky, kx] of fields [..., y, x]."""
    return np.asarray(dctn(field, axes=(-2, -1), norm="ortho"))


def samples_of(rec: Reconstruction) -> np.ndarray:
    """Return the posterior deviations of the heights [sample, y, x], um."""
    assert rec.height_samples is not None
    return rec.height_samples


def jackknife(
    numbers: Callable[[np.ndarray], np.ndarray], per_realisation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return numbers computed from the mean over realisations [realisation, ...], and their standard errors.

    Errors within one realisation hang together, so whole realisations are left out one by one.
    """
    n = len(per_realisation)
    total = per_realisation.sum(0)
    left_out = np.array([numbers((total - one) / (n - 1)) for one in per_realisation])
    return numbers(total / n), np.sqrt((n - 1) / n * np.sum((left_out - left_out.mean(0)) ** 2, axis=0))


def with_error(value: np.ndarray, error: np.ndarray) -> list[float]:
    """Return [value, standard error], rounded for the JSON."""
    return [round(float(value), 4), round(float(error), 4)]


def summarise_efficiency(done: list[dict[str, Any]]) -> dict[str, Any]:
    """Return root mean square errors, stated and found, over the bound; each with its standard error.

    `mean_error_by_band` is that of the mean over a batch: noise alone leaves 1 / sqrt(fits per batch). Realisations
    count alike: each mean square is taken over its batch's bound.
    """

    def over_bound(key: str, keep: slice) -> np.ndarray:
        parts = []
        for batch in done:
            bound = np.sum(batch["bound"][keep])
            parts.extend(np.sum(one[keep]) / bound for one in np.reshape(batch[key], (-1, len(BANDS))))
        return np.array(parts)

    def ratio(key: str, keep: slice) -> list[float]:
        return with_error(*jackknife(np.sqrt, over_bound(key, keep)))

    free, error = slice(1, None), over_bound("error", slice(1, None))
    return {
        "fits": len(error),
        "bound_um": float(np.sqrt(np.mean([sum(batch["bound"][1:]) for batch in done]))),
        "ratio": ratio("error", free),
        "ratio_lowest_highest": [float(np.sqrt(error.min())), float(np.sqrt(error.max()))],
        "stated_ratio": ratio("stated", free),
        "by_band": {name: ratio("error", slice(i, i + 1)) for i, name in enumerate(BANDS)},
        "stated_by_band": {name: ratio("stated", slice(i, i + 1)) for i, name in enumerate(BANDS)},
        "mean_error_by_band": {
            name: float(np.sqrt(over_bound("mean_error", slice(i, i + 1)).mean())) for i, name in enumerate(BANDS)
        },
        "bound_share": {
            n: round(float(np.mean([b["bound"][i] / sum(b["bound"][1:]) for b in done])), 3)
            for i, n in enumerate(BANDS)
        },
        "valid": float(np.mean([v for batch in done for v in batch["valid"]])),
    }


def efficiency_row(record: "Record", instrument: Instrument, n_fits: int, size: int) -> None:
    """Row 3: the root mean square error of the heights, piston removed, over its Cramer-Rao bound."""
    study = Efficiency(instrument, size)
    name = f"Cramer-Rao bound, random waves of {size} x {size}"
    done = [
        record.keep("3 batch", f"{name}, {b.start} to {b.stop - 1}", lambda b=b: study.batch(b))
        for b in batches(n_fits, study.per_batch)
    ]
    record.do(
        "3",
        f"{name}, {n_fits} fits",
        lambda: summarise_efficiency(done),
        "0.95-1.2, aim 1.05",
        lambda c: 0.95 <= c["ratio"][0] <= 1.2,
    )


# Row 4 -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Coverage:
    """Row 4: pulls of repeated noise on one surface, gains and offsets drawn anew from their priors each time.

    Attributes:
        name: of the case.
        instrument: what the fit believes.
        relief: the true surface.
        settings: of the fit; its priors are where gains and offsets come from.
        true_instrument: what made the counts.
        offset_sigma: if given, all offsets are wrong by this many prior deviations, of random sign, not drawn.
        n_rays: atoms per pixel.
    """

    name: str
    instrument: Instrument
    relief: Relief
    settings: ReconstructSettings
    true_instrument: Instrument
    offset_sigma: float | None = None
    n_rays: float = 3.5e4

    def counts(self, realisation: int) -> tuple[np.ndarray, np.ndarray]:
        """Return Poisson counts of one realisation and their expectation [detector, y, x]."""
        rng = np.random.default_rng([4, realisation])
        signal = expected_signal(self.true_instrument, self.relief)
        prior, n = self.settings.refine, len(signal)
        gain = np.exp(prior.gain_std * rng.standard_normal(n))
        drawn = rng.standard_normal(n)
        if self.offset_sigma is not None:
            drawn = self.offset_sigma * np.sign(drawn)
        offset = prior.offset_std * np.median(signal, axis=(1, 2)) * drawn
        expected = self.n_rays * (gain[:, None, None] * signal + offset[:, None, None])
        return rng.poisson(expected).astype(float), expected

    def batch(self, realisations: range) -> dict[str, Any]:
        """Return what `COLUMNS` says of the pulls of every realisation and group, and the share of valid pixels."""
        out: dict[str, Any] = {"pulls": [], "valid": []}
        for i in realisations:
            counts, expected = self.counts(i)
            rec = fit(counts, expected, self.instrument, self.settings, self.n_rays)
            true = self.relief.height
            groups = pulls_of(rec.height - true, samples_of(rec), rec.is_valid, true > 0.5 * true.max())
            out["pulls"].append({name: summary_of(pull) for name, pull in groups.items()})
            out["valid"].append(float(rec.is_valid.mean()))
        return out


def pulls_of(
    error: np.ndarray, samples: np.ndarray, is_valid: np.ndarray, is_summit: np.ndarray
) -> dict[str, np.ndarray]:
    """Return errors over their stated standard deviations, taken from posterior samples.

    Args:
        error: fit minus truth [y, x], um.
        samples: posterior deviations [sample, y, x], um.
        is_valid: pixels to count [y, x]; the bands take all pixels.
        is_summit: pixels where the surface is highest [y, x].

    Returns:
        `heights`: of the valid pixels; `inside`: of those off the border, which the fit may be told is flat; `shape`:
        as `heights`, each field less its mean; `summit`: of the valid ones of these pixels; and of the modes of each
        band.
    """

    def std(deviations: np.ndarray) -> np.ndarray:
        return np.sqrt(np.mean(deviations**2, axis=0))

    at, drawn, summit = error[is_valid], samples[:, is_valid], is_valid & is_summit
    inside = is_valid & ~border_mask(error.shape, ReconstructSettings().border_fraction)
    modes = modes_of(error) / std(modes_of(samples))
    band = band_of_modes(error.shape)
    return {
        "heights": at / std(drawn),
        "inside": error[inside] / std(samples[:, inside]),
        "shape": (at - at.mean()) / std(drawn - drawn.mean(1, keepdims=True)),
        "summit": error[summit] / std(samples[:, summit]),
        **{name: modes[band == i] for i, name in enumerate(BANDS)},
    }


def summary_of(pull: np.ndarray) -> list[float]:
    """Return the `COLUMNS` of pulls."""
    size = np.abs(pull)
    return [pull.size, *(float(np.mean(f)) for f in (pull, pull**2, size < 1, size < 2))]


def summarise_coverage(done: list[dict[str, Any]]) -> dict[str, Any]:
    """Return mean, standard deviation and coverage of every group's pulls, each with its standard error."""

    def numbers(mean: np.ndarray) -> np.ndarray:
        return np.array([mean[1], np.sqrt(max(mean[2] - mean[1] ** 2, 0.0)), mean[3], mean[4]])

    pulls = [one for batch in done for one in batch["pulls"]]
    out: dict[str, Any] = {"fits": len(pulls)}
    for group in pulls[0]:
        value, error = jackknife(numbers, np.array([one[group] for one in pulls]))
        names = ("mean", "std", "coverage_1", "coverage_2")
        out[group] = {n: with_error(v, e) for n, v, e in zip(names, value, error, strict=True)}
    return out | {"valid": float(np.mean([v for batch in done for v in batch["valid"]]))}


def turned_detectors(instrument: Instrument, degrees: float, only: int | None = None) -> Instrument:
    """Return the instrument with its detectors (or only one of them) at a larger polar angle.

    Seen from the nominal spot; an aperture moves outwards on the plate and keeps its axes.
    """
    moved = []
    for k, detector in enumerate(instrument.detector):
        assert detector.center_um is not None
        x, y = detector.center_um
        polar = np.arctan2(np.hypot(x, y), instrument.working_distance)
        factor = np.tan(polar + np.radians(degrees)) / np.tan(polar) if only in (None, k) else 1.0
        moved.append(detector.model_copy(update={"center_um": (x * factor, y * factor)}))
    return instrument.model_copy(update={"detector": tuple(moved)})


def is_honest(found: dict[str, Any]) -> bool:
    """Return whether the pulls of the valid pixels meet the goal of row 4."""
    h = {name: value for name, (value, _) in found["heights"].items()}
    return bool(
        abs(h["mean"]) <= 0.15
        and 0.9 <= h["std"] <= 1.15
        and 0.63 <= h["coverage_1"] <= 0.73
        and 0.92 <= h["coverage_2"] <= 0.98
    )


def coverage_cases(instrument: Instrument, size: int) -> tuple[list[Coverage], list[Coverage]]:
    """Return the well specified and the mis-specified cases of row 4."""
    axis = raster(size)
    hill = bump(axis, 60.0, 230.0)
    rough = random_waves(axis, 0, 0.05, 480.0).plus(bump(axis, 40.0, 280.0, (200.0, 100.0)))

    def settings(border: str, **refine: object) -> ReconstructSettings:
        return ReconstructSettings.model_validate({"border": border, "refine": {"samples": 128, **refine}})

    def case(name, relief, chosen, true=instrument, offset_sigma=None):
        return Coverage(f"{name}, {size} x {size}", instrument, relief, chosen, true, offset_sigma)

    flat = settings("flat")
    good = [case("bump, flat border", hill, flat), case("waves and bump, free border", rough, settings("free"))]
    bad = [
        case("offsets wrong by 5 % of the signal", hill, settings("flat", offset_std=0.05), offset_sigma=1.0),
        case("one detector 1 deg off", hill, flat, turned_detectors(instrument, 1.0, only=0)),
        case("all detectors 1 deg off", hill, flat, turned_detectors(instrument, 1.0)),
    ]
    return good, bad


def coverage_row(record: "Record", instrument: Instrument, n_fits: int, size: int, per_batch: int = 10) -> None:
    """Row 4: pulls of heights and of the bands of cosine modes; a quarter as many fits of each mis-specified case."""
    good, bad = coverage_cases(instrument, size)
    for case, is_good in [(c, True) for c in good] + [(c, False) for c in bad]:
        n = n_fits if is_good else max(n_fits // 4, 2)
        done = [
            record.keep("4 batch", f"{case.name}, {b.start} to {b.stop - 1}", lambda c=case, b=b: c.batch(b))
            for b in batches(n, per_batch)
        ]
        record.do(
            "4",
            f"pulls, {case.name}, {n} fits",
            lambda d=done: summarise_coverage(d),
            "mean 0 +- 0.15, s.d. 0.9-1.15, 63-73 %, 92-98 %" if is_good else ">= 90 % at 2 standard deviations",
            is_honest if is_good else lambda c: c["heights"]["coverage_2"][0] >= 0.9,
        )
