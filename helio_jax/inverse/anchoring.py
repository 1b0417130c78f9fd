"""Bring a fit to what is known of the heights beside its data, and compare each anchor with all else that is known.

Known are what the user states, and the steps that mask bands measure.

The joint posterior of a fit says how heights and instrument go with a sum of heights: known sums move all of them, as
in a Kalman filter, and shrink their errors. Unlike a fit to data and anchors together this needs no gains that are free
where they are better held (`explanations`), and one fit tells what the heights would be without each anchor. Valid to
first order: the data are tested on the heights as moved (`verdict`).
"""

from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.linalg import cholesky, solve_triangular

from helio_jax.forward.surface import Surface
from helio_jax.inverse.anchors import Anchors
from helio_jax.inverse.fit import Fit, at_state, with_posterior
from helio_jax.inverse.known_heights import anchor_name, anchors_of
from helio_jax.inverse.measured_steps import anchors_of_steps
from helio_jax.inverse.posterior import tilts_of
from helio_jax.inverse.quality import regions
from helio_jax.inverse.solver import free_parameters
from helio_jax.inverse.step_records import Steps

LIMIT = 3.5
"""Deviation from everything else at which an anchor is said to contradict it [standard deviations]: 1 in 2000 of right
ones does."""
MAX_PLACINGS = 3
"""An oblique beam sees a place elsewhere on the heights as moved: how often the pixels of the anchors are found."""
_ISLAND = 2, 4
"""Pixels of an anchored region that is an island at most: a factor of those anchored, and more."""
COHERENT = 0.25
"""A measured step counts if it moves the median pixel of each side by this share of the side's mean at least."""
MEASURED = "mask bands"
"""Kind of an anchor that is measured."""


@dataclass(frozen=True)
class AnchorCheck:
    """What an anchor did; heights in um, of the sum of heights that it is about.

    Attributes:
        name, kind: as stated; name: its number by default. A measured step has the kind `MEASURED`.
        stated, stated_std: height and standard deviation that were stated, or follow from the length of the mask.
        fitted: height of the map.
        without, without_std: what data, priors and the other anchors say, those left out that contradict them.
        pull: (stated - without) / standard deviation of that difference.
        agrees: whether the pull is below `LIMIT` and depth jumps do not part the place, or a few pixels of a measured
            step, from all around it.
    """

    name: str
    kind: str
    stated: float
    stated_std: float
    fitted: float
    without: float
    without_std: float
    pull: float
    agrees: bool

    def sentence(self) -> str:
        """Write what to know of one that does not agree."""
        if self.kind == MEASURED and abs(self.pull) <= LIMIT:
            return (
                f"{self.name} is {self.stated:.4g} +- {self.stated_std:.2g} um high by its mask bands, and would move "
                "only a few of its pixels, which depth jumps part from the others: not used"
            )
        if self.kind == MEASURED:
            return (
                f"{self.name} is {self.stated:.4g} +- {self.stated_std:.2g} um high by its mask bands and "
                f"{self.without:.4g} +- {self.without_std:.2g} um by all else, {abs(self.pull):.1f} standard "
                "deviations apart: not used, the error bars contain the difference"
            )
        about = f"anchor {self.name!r} ({self.kind} {self.stated:.4g} +- {self.stated_std:.2g} um)"
        if abs(self.pull) <= LIMIT:
            return f"{about} is at pixels that depth jumps part from all around them: it determines little of the rest"
        return (
            f"{about} contradicts all else that is known by {abs(self.pull):.1f} standard deviations: without it "
            f"{self.without:.4g} +- {self.without_std:.2g} um; check it, or leave it out"
        )


def by_anchors(known: np.ndarray, off: np.ndarray, used: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Estimate sums of heights from all that is known of them beside their anchors, and from some of these.

    Not by leaving anchors out of an estimate from all: where only anchors fix a level, what is known without them is
    then lost to rounding.

    Args:
        known: covariance of the sums without anchors, in the anchors' standard deviations [anchor, anchor].
        off: (estimate without anchors - anchor) / standard deviation [anchor].
        used: numbers of those that are used.

    Returns:
        Covariance and (estimate - anchor) / standard deviation with those.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning (2006), algorithm 2.1.
    """
    if not used:
        return known, off
    factor = cholesky(known[np.ix_(used, used)] + np.eye(len(used)), lower=True)
    share = solve_triangular(factor, known[used], lower=True)
    return known - share.T @ share, off - share.T @ solve_triangular(factor, off[used], lower=True)


def pulls_of(known: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Compare every anchor with all else; those that contradict it most count no more for the others.

    Args:
        known, off: as in `by_anchors`.

    Returns:
        Estimate without the anchor minus the anchor, standard deviation of that estimate, and pull, all in standard
        deviations of the anchors [3, anchor].
    """
    n, wrong = len(off), []
    while True:
        found = np.zeros((3, n))
        for i in range(n):
            rest, left = by_anchors(known, off, [k for k in range(n) if k != i and k not in wrong])
            std = np.sqrt(max(rest[i, i], 0.0))
            found[:, i] = left[i], std, -left[i] / np.hypot(1.0, std)
        worse = [i for i in range(n) if i not in wrong and abs(found[2, i]) > LIMIT]
        if not worse:
            return found
        wrong.append(max(worse, key=lambda i: abs(found[2, i])))


class _Known(NamedTuple):
    """Anchors with their names and kinds, in their order."""

    names: tuple[tuple[str, str], ...]
    anchors: Anchors

    @property
    def is_measured(self) -> np.ndarray:
        """Which are measured steps [anchor]."""
        return np.array([kind == MEASURED for _, kind in self.names], bool)

    @classmethod
    def of(cls, fit: Fit, surface: Surface, steps: Steps | None) -> "_Known":
        """Find the pixels of all anchors on a surface near the one sought."""
        problem = fit.problem
        stated = problem.reconstruct_settings.anchor
        detectors = () if problem.instrument is None else problem.instrument.detector_names
        anchors = anchors_of(stated, problem.raster, problem.optics, surface, detectors)
        names = [(anchor_name(i, one), one.kind) for i, one in enumerate(stated)]
        region = regions(fit.joined_x, fit.joined_y)
        is_free = problem.reconstruct_settings.border == "free"  # there, a fit is held at steps, not at levels
        levels = (Anchors.none(region.shape) if is_free else problem.anchors).within_one(region)
        if steps is not None:
            numbers, measured = anchors_of_steps(steps, surface, problem.raster, region)
            # beside walls, multiple scattering disturbs heights the most: a mean over a whole level is the better sum
            is_level = np.any(levels.weight > 0.0, axis=0)
            other = np.array([not is_level[pixels].any() for pixels in measured.weight != 0.0], bool)
            anchors = anchors.and_also(measured.taken(other))
            names += [(f"step {n}", MEASURED) for n, is_other in zip(numbers, other, strict=True) if is_other]
        names += [(f"level {number}", MEASURED) for number in range(1, 1 + len(levels.value))]
        return cls(tuple(names), anchors.and_also(levels))


class Anchored(NamedTuple):
    """A fit that was brought to anchors.

    Attributes:
        fit: with error bars.
        checks: what each anchor did.
        used: the anchors that it was brought to.
    """

    fit: Fit
    checks: tuple[AnchorCheck, ...]
    used: Anchors


def with_anchors(fit: Fit, steps: Steps | None = None) -> Anchored:
    """Compute the error bars of a fit (`with_posterior`), and bring it to what is known beside its data, if anything.

    Without error bars (interrupted, or `samples = 0`) anchors are not used. Levels, and with a free border steps, that
    the fit was held at are taken for what they are, measured steps: error bars of a fit that holds them would be those
    of its own data, which it trusts too much beside walls. That a measured step contradicts all else shows less in a
    fit that was held at it.

    Args:
        fit: without error bars.
        steps: measured in its micrographs.

    Raises:
        SceneError: as `anchors_of`.
    """
    found, anchors = Anchored(fit, (), fit.problem.anchors), None
    free = replace(fit, problem=replace(fit.problem, anchors=Anchors.none(fit.problem.raster.shape)))
    for _ in range(MAX_PLACINGS):
        known = _Known.of(fit, found.fit.surface, steps)
        if not known.names:
            return found._replace(fit=with_posterior(fit))
        if anchors is not None and np.array_equal(known.anchors.weight, anchors.weight):
            break
        anchors = known.anchors
        before = with_posterior(free, anchors)
        if before.posterior is None:
            return found._replace(fit=before)
        found = _moved(before, known)
    return found


def _moved(fit: Fit, given: _Known) -> Anchored:
    """Move a fit with error bars to anchors.

    Where a stated one contradicts all else, what they changed is an error of its own; a measured one that does is not
    used, and what it would have changed is.

    Source: Kalman, J. Basic Eng. 82 (1960) 35; samples: Hoffman and Ribak, Astrophys. J. 380 (1991) L5.
    """
    posterior, anchors = fit.posterior, given.anchors
    assert posterior is not None and posterior.sums is not None
    sums, shape = posterior.sums, fit.surface.height.shape
    weight, n = anchors.weight.reshape(len(anchors.value), -1), len(anchors.value)
    factor = float(sums.inflation.max()) * posterior.inflation**2
    modes = np.zeros((0, *shape)) if posterior.common_modes is None else posterior.common_modes
    by_modes = weight @ modes.reshape(len(modes), -1).T
    surface, instrument = factor * sums.surface, factor * sums.instrument
    surface[:, 0] += np.einsum("ae,eyx->ayx", by_modes, modes)
    heights = _levelled(fit, surface[:, 0], instrument).reshape(n, -1)
    known = factor * sums.own + by_modes @ by_modes.T
    inverse = np.linalg.inv(known + np.eye(n))
    off = weight @ fit.surface.height.ravel() - anchors.value
    of_all = inverse @ off
    pulls = pulls_of(known, off)
    is_wrong = np.abs(pulls[2]) > LIMIT
    is_of_few = given.is_measured & ~are_coherent(anchors.weight, surface[:, 0])
    is_used = ~(is_wrong & given.is_measured) & ~is_of_few
    inverse = np.zeros((n, n))
    inverse[np.ix_(is_used, is_used)] = np.linalg.inv((known + np.eye(n))[np.ix_(is_used, is_used)])
    answer = inverse @ off
    checks = _checks(fit, given, pulls, off - known @ answer, is_of_few)

    state = fit.state
    height, slope_x, slope_y = -np.tensordot(answer, surface, 1)
    with jax.enable_x64(True):
        flat, restore = free_parameters(state.parameters)
        parameters = jax.tree.map(np.asarray, restore(flat - answer @ instrument))
    moved = replace(
        state,
        surface=Surface(
            state.surface.height + height, state.surface.slope_x + slope_x, state.surface.slope_y + slope_y
        ),
        parameters=parameters,
    )

    def brought(changes: np.ndarray) -> np.ndarray:
        """Bring changes of the heights, which the posterior contains, to the anchors [..., y, x]."""
        moves = changes.reshape(-1, weight.shape[1]) @ weight.T @ inverse @ heights
        return changes - moves.reshape(changes.shape)

    drawn = posterior.samples.reshape(len(posterior.samples), -1)
    # other numbers than those of the posterior (seed 0) and of its common modes (1, 2, ...)
    drawn_off = drawn @ weight.T + np.random.default_rng([0, 1]).standard_normal((len(drawn), n))
    of_instrument, ways = np.linalg.eigh(posterior.instrument_covariance - instrument.T @ inverse @ instrument)
    conditioned = replace(
        posterior,
        samples=(drawn - drawn_off @ inverse @ heights).reshape(posterior.samples.shape),
        instrument_samples=posterior.instrument_samples - drawn_off @ inverse @ instrument,
        instrument_covariance=(ways * np.maximum(of_instrument, 1e-6)) @ ways.T,
        common_modes=brought(modes),
    )
    if is_wrong.any():  # either the anchor is wrong, or all else
        change = of_all if (is_wrong & is_used).any() else of_all - answer
        conditioned = conditioned.with_common_mode((change @ heights).reshape(shape))
    score, rival = fit.geometry_score, fit.rival_change  # of other instruments, whose heights go through them, too
    found = replace(
        at_state(fit, moved, conditioned),
        geometry_score=score and replace(score, height_change=brought(score.height_change)),
        rival_change=None if rival is None else brought(rival),
    )
    return Anchored(found, checks, anchors.taken(is_used))


def _levelled(fit: Fit, height: np.ndarray, instrument: np.ndarray) -> np.ndarray:
    """Return changes of heights above the substrate, which may tilt with the instrument [sum, y, x], um."""
    assert fit.posterior is not None
    tilts, planes = tilts_of(fit.posterior.names), fit.problem.priors.tilt * fit.problem.position
    return height - np.einsum("at,tyx->ayx", instrument[:, tilts], planes[: len(tilts)])


def are_coherent(weight: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Whether sums of heights move the pixels of each side together [sum].

    Where a few pixels are nearly parted from the others by depth jumps, a sum that is off moves those alone, and far: a
    false step raised 12 of 70 pixels by 2 mm.

    Args:
        weight: of the pixels in the sums [sum, y, x].
        change: of the heights by a change of each sum, to any scale [sum, y, x].
    """
    out = np.ones(len(weight), bool)
    for i, (w, c) in enumerate(zip(weight, change, strict=True)):
        sides = [side for side in (w > 0.0, w < 0.0) if side.any()]
        most = max(abs(np.average(c[side], weights=w[side])) for side in sides)
        for side in sides:
            mean = abs(np.average(c[side], weights=w[side]))
            out[i] &= mean < COHERENT * most or np.median(np.abs(c[side])) >= COHERENT * mean
    return out


def _checks(
    fit: Fit, given: _Known, pulls: np.ndarray, left: np.ndarray, is_of_few: np.ndarray
) -> tuple[AnchorCheck, ...]:
    """Record what every anchor did.

    Args:
        pulls: of `pulls_of`.
        left: what the map is off the anchors [anchor].
        is_of_few: those that would move a few pixels alone (`are_coherent`) [anchor].
    """
    anchors, (off, std, pull) = given.anchors, pulls
    region, out = regions(fit.joined_x, fit.joined_y), []
    for i, (name, kind) in enumerate(given.names):
        unit = 1.0 / float(np.maximum(anchors.weight[i], 0.0).sum())
        value = float(anchors.value[i]) * unit
        is_parted = is_of_few[i] if kind == MEASURED else _is_island(region, anchors.weight[i])
        out.append(
            AnchorCheck(
                name=name,
                kind=kind,
                stated=value,
                stated_std=unit,
                fitted=value + float(left[i]) * unit,
                without=value + float(off[i]) * unit,
                without_std=float(std[i]) * unit,
                pull=float(pull[i]),
                agrees=bool(abs(pull[i]) <= LIMIT and not is_parted),
            )
        )
    return tuple(out)


def _is_island(region: np.ndarray, weight: np.ndarray) -> bool:
    """Whether depth jumps part the pixels of an anchor, above or below, from all around them."""
    factor, more = _ISLAND
    parts = (weight > 0, weight < 0)
    return any(np.isin(region, region[p]).sum() <= factor * p.sum() + more for p in parts if p.any())


def as_records(found: tuple[AnchorCheck, ...]) -> list[dict[str, Any]]:
    """Make JSON-compatible records."""
    return [asdict(one) for one in found]
