"""The choice between instruments that explain one fit's micrographs: as stated, another geometry, another read-out.

A wrong geometry, background that nobody subtracted and patches of another albedo can look alike. Each is fitted, and
the fit with the least misfit is kept; another geometry has to be better by `LIKELY`, as it has more numbers to fit. It
has to be better by `UNDECIDED` than gains and offsets at whose fit the micrographs ask for no other geometry (the score
test of `geometry_score`). A fit that did not converge is never kept for another one. Where a fit that is not kept is
hardly worse (`UNDECIDED`), the error bars contain its heights.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np

from helio_jax.errors import PredictionError
from helio_jax.inverse.albedo_patches import AlbedoPatches
from helio_jax.inverse.convergence import has_converged
from helio_jax.inverse.fit import Fit, interrupted, largest_change
from helio_jax.inverse.geometry_change import LIKELY, GeometryScore, largest_changes
from helio_jax.inverse.geometry_score import score_geometry, surface_misfit
from helio_jax.inverse.levels import GAIN
from helio_jax.inverse.parameters import Parameters
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.strain import instrument_pulls
from helio_jax.inverse.wider_readout import READOUT, Widths, heavy_tailed_penalty, widths

FEW_DETECTORS = 3
"""The pulls of a fitted geometry may reach `GAIN` (half chi-square) with up to so many detectors; with more detectors
in proportion, for a plate that is turned moves all apertures."""
UNDECIDED = 0.5 * GAIN
"""Fits whose half chi-square of data and instrument is larger by less than this may be right as well. As much may a
geometry gain by chance where gains and offsets are right: in simulations with background up to 11."""
TRIED = "while another instrument was tried"
"""Said of a fit that was interrupted meanwhile."""

Refit = Callable[[Fit, AlbedoPatches, Widths, Callable[[FitProblem], Parameters]], Fit]
"""Fit with an uncertain geometry from the surface of a fit.

Arguments: that fit, patches of other albedos, widths of the priors of gains and offsets over those stated, and what
makes the parameters to start from.
"""


@dataclass(frozen=True)
class InstrumentChoice:
    """What other instruments are fitted to one stack, and which is kept.

    Attributes:
        refit: see `Refit`.
        is_explained: whether a fit can be traced, and the data contradict it in no more pixels than the one to begin
            with.
        say: reports what is tried.
    """

    refit: Refit
    is_explained: Callable[[Fit], bool]
    say: Callable[[str], None]

    def best_of(self, fit: Fit, readout: Fit | None) -> Fit:
        """Choose between a converged fit and those with other instruments.

        Interrupted, it returns the best one so far.

        Args:
            fit: the best one so far, with the geometry as stated.
            readout: with wider priors of gains and offsets, kept or not; None: none was made.
        """
        chosen = fit
        try:
            score = score_geometry(fit)
            if score is None or not (score.is_likely or fit.prior_widths):
                return fit
            if score.is_likely:
                chosen = fit = replace(fit, geometry_score=score)
            self.say(f"the geometry is fitted, too; the micrographs may ask for {largest_changes(score.values)}")
            found = [(total_misfit(fit), fit)]
            for other in self._others(fit, score, readout):
                if other.is_interrupted:
                    return interrupted(chosen, TRIED)
                if is_plausible(other) and self.is_explained(other):
                    found.append((total_misfit(other), other))
                    chosen = least_misfit(found)
        except KeyboardInterrupt:
            chosen = interrupted(chosen, TRIED)
        return chosen

    def _others(self, fit: Fit, score: GeometryScore, readout: Fit | None) -> Iterator[Fit]:
        """Fit other instruments, one after the other: the read-out, the geometry, both.

        Patches of other albedos may stand for a wrong geometry: it is fitted without them, too. Read-out and geometry
        are fitted together only where the data ask for another geometry when the read-out is fitted alone.
        """
        stated = dict.fromkeys(READOUT, 1.0)
        if readout is not None and readout.state is fit.state:
            readout = fit
        elif readout is not None:
            of_readout = score_geometry(readout) if is_at_rest(readout) else None
            readout = replace(readout, geometry_score=of_readout if of_readout and of_readout.is_likely else None)
            yield readout
        patches = fit.problem.patches
        for known in (AlbedoPatches.none(patches.number.shape), patches) if patches.objects else (patches,):
            yield from self._with_geometry(fit, score, known, stated)
        if readout is not None and (of_both := readout.geometry_score) is not None:
            yield from self._with_geometry(readout, of_both, readout.problem.patches, widths(readout))

    def _with_geometry(self, fit: Fit, score: GeometryScore, patches: AlbedoPatches, factors: Widths) -> Iterator[Fit]:
        """Fit with an uncertain geometry, from where the score says that this ends; nothing where it cannot be traced.

        `factors`: widths of the priors over those stated.
        """

        def start(problem: FitProblem) -> Parameters:
            p, before = score.parameters, widths(fit)
            scaled = {name: before[name] / factors[name] * getattr(p, name) for name in READOUT}
            patch = p.patch if patches is fit.problem.patches else problem.stated_parameters().patch
            return p.replaced(patch=patch, **scaled)

        try:
            found = self.refit(fit, patches, factors, start)
        except PredictionError as e:
            self.say(f"another instrument is given up: {e}")
        else:
            yield replace(found, geometry_score=score)


def least_misfit(found: Sequence[tuple[float, Fit]]) -> Fit:
    """Return the fit to keep, with the change of its heights by that of the others that may be right as well.

    `found`: total misfits and fits, the first one with the geometry as stated, and converged.
    """
    at_rest = found[0], *(one for one in found[1:] if is_at_rest(one[1]))
    simpler = [one for one in at_rest if not one[1].is_geometry_fitted]
    geometry = min((one for one in at_rest if one[1].is_geometry_fitted), key=itemgetter(0), default=None)
    is_better = geometry is not None and all(geometry[0] < of_one - _lead(one) for of_one, one in simpler)
    misfit, chosen = geometry if geometry is not None and is_better else min(simpler, key=itemgetter(0))
    changes = [
        other.surface.height - chosen.surface.height
        for of_other, other in found
        if other is not chosen and of_other < misfit + UNDECIDED
    ]
    return replace(chosen, rival_change=largest_change(changes) if changes else None)


def _lead(fit: Fit) -> float:
    """Return by how much a fitted geometry has to be better than a fit without, in half chi-square."""
    return UNDECIDED if fit.prior_widths and fit.geometry_score is None else LIKELY


def is_at_rest(fit: Fit) -> bool:
    """Whether a fit has converged: until then its misfit is not that of its surface."""
    return has_converged(fit.changes, fit.problem.settings.tolerance_um)


def total_misfit(fit: Fit) -> float:
    """Compute half the chi-square of data, surface and instrument, gains and offsets by the heavy-tailed prior.

    Patches of other albedos count as `GAIN`.
    """
    of_readout = heavy_tailed_penalty(fit.parameters, widths(fit))
    return surface_misfit(fit) + _of_geometry(fit) + of_readout + (GAIN if fit.problem.patches.objects else 0.0)


def is_plausible(fit: Fit) -> bool:
    """Whether the geometry of a fit is not too unlikely (`FEW_DETECTORS`)."""
    return _of_geometry(fit) <= GAIN * max(1.0, len(fit.problem.signal) / FEW_DETECTORS)


def _of_geometry(fit: Fit) -> float:
    """Compute half the chi-square of a fit's instrument without gains and offsets."""
    return 0.5 * float(np.sum(instrument_pulls(fit.parameters, READOUT) ** 2))
