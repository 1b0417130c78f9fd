"""Gains or offsets far from what is stated: a fit with a heavy-tailed prior of them.

A stated gain or offset may be plainly wrong, by many of its standard deviations: background that nobody subtracted. A
normal prior holds the fit between the stated and the true one, with heights that are wrong by more than any error bar.
So a fit that strains the instrument is repeated with Student's t as the prior of the offsets, or of the gains. The
solver knows normal priors only: one as wide as to have the same gradient at the fitted numbers stands for it
(`normal_widths`).
"""

import math
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from helio_jax.errors import PredictionError
from helio_jax.forward.surface import Surface
from helio_jax.inverse.fit import Fit, interrupted
from helio_jax.inverse.parameters import Parameters
from helio_jax.inverse.quality import half_chi_square
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.inverse.strain import instrument_pulls, is_strained, strain_improvement

READOUT = {"offset": "offset_std", "log_gain": "gain_std"}
"""Parameters of the read-out, the likelier to be wrong first, and the settings of their prior standard deviations."""
WARNING = (
    "gains or offsets are not what is stated, and were fitted: {far}; check dark counts, background and the detectors' "
    "gains; a wrong geometry can look alike: heights may be off by more than their stated standard deviations"
)
"""Of a fit whose gains and offsets are far from what is stated (`FAR`)."""
NEARLY = (
    "gains or offsets were fitted with priors wider than stated; the farthest from what is stated: {far}; a wrong "
    "geometry can look alike: heights may be off by more than their stated standard deviations"
)
"""Of a fit with such priors whose gains and offsets are not far from it."""
FAR = 3.0
"""They are named where they are so many stated standard deviations off."""
FREEDOM = 3.0
"""Degrees of freedom of Student's t."""
MAX_FITS = 3
"""Fits with wider and wider priors."""
SAME_WIDTH = 1.2
"""A prior is not made wider again by less than this factor."""

WIDER_TRIED = "while wider priors of gains and offsets were tried"
"""Said of a fit that was interrupted meanwhile."""

Widths = Mapping[str, float]
"""Standard deviation of the priors of gains and offsets over those stated, by name (`READOUT`)."""


def fit_wider_readout(
    fit: Fit,
    start: tuple[Surface, Surface],
    fitted: Callable[[Surface, Surface, Widths], Fit],
    say: Callable[[str], None],
) -> Fit | None:
    """Fit with a heavy-tailed prior of the offsets; where the fit still strains the instrument, of the gains.

    Args:
        fit: which strains the instrument.
        start: surface to fit from, and a smoother one. Not the fit's own, where another is known: a fit that a wrong
            prior held down overshoots from there, and rests at a larger misfit.
        fitted: fits from a surface, or one nearer to a smoother one, with wider priors.
        say: reports what is tried.

    Returns:
        The fit that explains data and instrument best, marked as interrupted where one was; None where no other one
        explains more.
    """
    best = fit
    for name in READOUT:
        found = _with_wider_prior(fit, name, start, fitted, say)
        best = max(best, found, key=partial(evidence, fit))
        if found.is_interrupted:
            return interrupted(best, WIDER_TRIED)
        if not is_strained(best.parameters, best.problem.held):
            break
    return None if best is fit else best


def _with_wider_prior(fit: Fit, name: str, start, fitted, say) -> Fit:
    """Fit with a heavy-tailed prior of the gains or the offsets; the best of these fits and the one without."""
    best, (surface, smoothed) = fit, start
    for _ in range(MAX_FITS):
        before = widths(best)
        width = normal_widths(best.parameters, before)[name]
        if width < SAME_WIDTH * before[name]:
            break
        say(f"{READOUT[name]} {width:.3g} times as large as stated")
        try:
            found = fitted(surface, smoothed, {name: width})
        except PredictionError as e:
            say(f"the wider prior is given up: {e}")
            break
        except KeyboardInterrupt:
            return interrupted(best, WIDER_TRIED)
        better = max(best, found, key=partial(evidence, best))
        if found.is_interrupted:
            return interrupted(better, WIDER_TRIED)
        if better is best:
            break
        best, surface = better, better.state.surface
    return best


def evidence(fit: Fit, other: Fit) -> float:
    """Compute by how much another fit explains data and instrument better than a fit, in half chi-square."""
    of_data = half_chi_square(fit.residuals) - half_chi_square(other.residuals)
    return of_data + instrument_improvement(fit, other)


def instrument_improvement(fit: Fit, other: Fit) -> float:
    """Compute by how much less likely a fit's instrument is than another fit's, in half chi-square.

    Gains and offsets count by the heavy-tailed prior where one of the fits has it.
    """
    both = [(each.parameters, widths(each)) for each in (fit, other)]
    if both[0][1] == both[1][1]:
        return strain_improvement(fit.parameters, other.parameters)
    before, after = (
        0.5 * float(np.sum(instrument_pulls(parameters, READOUT) ** 2)) + heavy_tailed_penalty(parameters, factors)
        for parameters, factors in both
    )
    return before - after


def warning_of(fit: Fit) -> tuple[str, ...]:
    """Name the gains and offsets that lie far from what is stated, where a fit strains the instrument or had wider
    priors of them; of those with wider priors one at least."""
    factors = widths(fit)
    has_wider = max(factors.values()) > 1.0
    if not has_wider and not is_strained(fit.parameters, fit.problem.held):
        return ()
    stated = {key: getattr(fit.problem.settings, key) / factors[name] for name, key in READOUT.items()}
    changes = {
        "gain": (fit.gain - 1.0, stated["gain_std"]),
        "offset": (fit.offset / fit.problem.median_signal, stated["offset_std"]),
    }
    named = [
        (abs(value) / std, f"{what} of {name!r} {value:+.1%} (stated: 0 +- {std:.1%})")
        for what, (values, std) in changes.items()
        for name, value in zip(fit.instrument.detector_names, values, strict=True)
    ]
    far = [text for pull, text in named if pull > FAR]
    if far:
        return (WARNING.format(far=", ".join(far)),)
    return (NEARLY.format(far=max(named)[1]),) if has_wider else ()


def priors_of(fit: Fit) -> dict[str, float]:
    """Prior standard deviations of gains and offsets with which a fit was made, by the names of their settings."""
    return {key: getattr(fit.problem.settings, key) for key in READOUT.values()}


def widths(fit: Fit) -> Widths:
    """Return the widths of a fit's priors of gains and offsets over those stated."""
    return dict.fromkeys(READOUT, 1.0) | dict(fit.prior_widths)


def normal_widths(parameters: Parameters, factors: Widths) -> Widths:
    """Compute the widths of the normal priors that stand for the heavy-tailed one.

    They have at the fitted parameters the gradient of a multivariate Student's t of the stated width.

    Args:
        parameters: fitted, in standard deviations of their priors.
        factors: widths of these priors.

    Source: weights of the t distribution: Lange, Little and Taylor, J. Am. Stat. Assoc. 84 (1989) 881, eq. 3.
    """
    squares = _squares(parameters, factors)
    return {name: max(1.0, math.sqrt((FREEDOM + total) / (FREEDOM + n))) for name, (total, n) in squares.items()}


def heavy_tailed_penalty(parameters: Parameters, factors: Widths) -> float:
    """Compute minus the log of the heavy-tailed prior of gains and offsets, 0 at its maximum.

    Arguments as those of `normal_widths`.
    """
    squares = _squares(parameters, factors).values()
    return sum(0.5 * (FREEDOM + n) * math.log1p(total / FREEDOM) for total, n in squares)


def _squares(parameters: Parameters, factors: Widths) -> dict[str, tuple[float, int]]:
    """Compute the sum of squares, in stated standard deviations, and the number of gains and offsets."""
    pulls = {name: factors[name] * np.ravel(getattr(parameters, name)) for name in READOUT}
    return {name: (float(np.sum(p**2)), p.size) for name, p in pulls.items()}


def with_widths(settings: ReconstructSettings, factors: Widths) -> ReconstructSettings:
    """Give the priors of gains and offsets other widths; they may exceed what a scene file may state."""
    wide = {READOUT[name]: factor * getattr(settings.refine, READOUT[name]) for name, factor in factors.items()}
    return settings.model_copy(update={"refine": settings.refine.model_copy(update=wide)})
