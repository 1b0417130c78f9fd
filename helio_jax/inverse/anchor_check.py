"""Whether each anchor that the user states agrees with all else that is known of the heights.

A fit with anchors says of each what the heights are there, and what they would be without it. Both follow from one fit:
leaving an anchor out changes a linear least-squares estimate by a closed form of its residual and its leverage.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from helio_jax.inverse.fit import Fit
from helio_jax.inverse.known_heights import anchor_name
from helio_jax.inverse.quality import regions

LIMIT = 3.5
"""Deviation from everything else at which an anchor is said to contradict it [standard deviations]: 1 in 2000 of right
ones does."""
_ISLAND = 2, 4
"""Pixels of an anchored region that is an island at most: a factor of those anchored, and more."""


@dataclass(frozen=True)
class AnchorCheck:
    """What an anchor did; heights in um, of the sum of heights that it is about.

    Attributes:
        name, kind: as stated; name: its number by default.
        stated, stated_std: height and standard deviation that were stated, or follow from the length of the mask.
        fitted: height of the map.
        without, without_std: what data, priors and the other anchors say, those left out that contradict them.
        pull: (stated - without) / standard deviation of that difference.
        agrees: whether the pull is below `LIMIT` and depth jumps do not part the place from all around it.
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
        about = f"anchor {self.name!r} ({self.kind} {self.stated:.4g} +- {self.stated_std:.2g} um)"
        if abs(self.pull) <= LIMIT:
            return f"{about} is reached only by depth jumps all around it: the surface beside it is elsewhere; check it"
        return (
            f"{about} contradicts all else that is known by {abs(self.pull):.1f} standard deviations: without it "
            f"{self.without:.4g} +- {self.without_std:.2g} um; check it, or leave it out"
        )


def leave_out(leverage: np.ndarray, residual: np.ndarray, out: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Leave data out of a linear least-squares estimate.

    Args:
        leverage: posterior covariance of what the data measure, in their standard deviations [datum, datum].
        residual: (estimate - datum) / standard deviation [datum].
        out: numbers of those that are left out.

    Returns:
        Leverage and residual without them.

    Source: Cook and Weisberg, Residuals and Influence in Regression (1982), sec. 2.2.
    """
    if not out:
        return leverage, residual
    by = leverage[:, out] @ np.linalg.inv(np.eye(len(out)) - leverage[np.ix_(out, out)])
    return leverage + by @ leverage[out], residual + by @ residual[out]


def pulls_of(
    leverage: np.ndarray, residual: np.ndarray, inflation: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compare every anchor with all else; those that contradict it most count no more for the others.

    Args:
        leverage, residual: as in `leave_out`.
        inflation: variance of the fitted heights over that of errors which are independent [anchor].

    Returns:
        Deviation of the estimate without the anchor from it, standard deviation of that estimate, and pull; all in
        standard deviations of the anchors [anchor].
    """
    n, wrong = len(residual), []
    while True:
        found = np.array([_without(leverage, residual, inflation, i, [k for k in wrong if k != i]) for i in range(n)])
        pull = -found[:, 0] / np.hypot(1.0, found[:, 1])
        left = [i for i in range(n) if i not in wrong and abs(pull[i]) > LIMIT]
        if not left:
            return found[:, 0], found[:, 1], pull
        wrong.append(max(left, key=lambda i: abs(pull[i])))


def _without(
    leverage: np.ndarray, residual: np.ndarray, inflation: np.ndarray, i: int, wrong: list[int]
) -> tuple[float, float]:
    rest, off = leave_out(leverage, residual, [*wrong, i])
    return float(off[i]), float(np.sqrt(inflation[i] * max(rest[i, i], 0.0)))


def check_anchors(fit: Fit) -> tuple[AnchorCheck, ...]:
    """Compare every anchor of the user with data, priors and the other anchors; none without error bars.

    The leverage is that of the fit, which takes errors for independent. The variance of what is compared is enlarged by
    what correlated errors of the model and the Birge ratio do to it; common-mode errors are added.
    """
    stated, posterior, problem = fit.problem.reconstruct_settings.anchor, fit.posterior, fit.problem
    if not stated or posterior is None or posterior.anchor_leverage is None:
        return ()
    anchors = problem.user_anchors
    residual = np.einsum("ayx,yx->a", anchors.weight, fit.surface.height) - anchors.value
    leverage = np.minimum(np.diag(posterior.anchor_leverage), 1.0 - 1e-9)
    inflation = posterior.anchor_inflation * posterior.inflation**2
    if posterior.common_modes is not None:
        modes = np.einsum("ayx,eyx->ae", anchors.weight, posterior.common_modes)
        inflation = inflation + np.sum(modes**2, 1) / np.maximum(leverage, 1e-9)
    off, std, pull = pulls_of(posterior.anchor_leverage, residual, inflation)
    region = regions(fit.joined_x, fit.joined_y)
    out = []
    for i, anchor in enumerate(stated):
        unit = 1.0 / float(np.maximum(anchors.weight[i], 0.0).sum())
        value = float(anchors.value[i]) * unit
        out.append(
            AnchorCheck(
                name=anchor_name(i, anchor),
                kind=anchor.kind,
                stated=value,
                stated_std=unit,
                fitted=value + float(residual[i]) * unit,
                without=value + float(off[i]) * unit,
                without_std=float(std[i]) * unit,
                pull=float(pull[i]),
                agrees=bool(abs(pull[i]) <= LIMIT and not _is_island(region, anchors.weight[i])),
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
