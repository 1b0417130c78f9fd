"""Gauss-Newton steps for a few common unknowns and a small block of own unknowns in every pixel.

residual_kn = data - model(common, own_n): k data in each of n pixels. The block of every pixel is eliminated (Schur
complement, as in bundle adjustment), so that one step costs O(n) and no matrix is larger than the common unknowns. Used
by the fits whose own unknowns are a surface normal: linearise the model, call `eliminate`, solve for the common step,
then take the pixel steps. Limits of the steps and priors of the common unknowns are the caller's.

Source: Triggs et al., Bundle Adjustment, LNCS 1883 (2000) 298, sec. 6.1; variable projection: Golub & Pereyra, Inverse
Problems 19 (2003) R1; tests/unit/test_block_fit.py.
"""

from typing import NamedTuple

import numpy as np


class Eliminated(NamedTuple):
    """Normal equations without the pixels' unknowns.

    Attributes:
        information: of the common unknowns, their priors excluded [c, c].
        right: right side, so that information @ step = right [c].
        covariance: of the unknowns of each pixel, the common ones held [n, b, b].
        own_right: right side of each pixel [n, b].
        coupling: of each pixel's unknowns with the common ones [n, b, c].
    """

    information: np.ndarray
    right: np.ndarray
    covariance: np.ndarray
    own_right: np.ndarray
    coupling: np.ndarray

    def pixel_steps(self, common_step: np.ndarray | None = None) -> np.ndarray:
        """Compute the steps of all pixels [n, b] that belong to a step of the common unknowns [c]; default: none."""
        right = self.own_right if common_step is None else self.own_right - self.coupling @ common_step
        return np.einsum("nij,nj->ni", self.covariance, right)


def eliminate(
    residual: np.ndarray,
    weight: np.ndarray,
    by_own: np.ndarray,
    by_common: np.ndarray | None = None,
    own_prior: tuple[np.ndarray, np.ndarray] | None = None,
    damping: float = 0.0,
) -> Eliminated:
    """Eliminate the unknowns of every pixel from the normal equations.

    Args:
        residual: data minus model [k, n].
        weight: inverse variance of each datum, 0 where there is none [k, n].
        by_own: derivative of the model by the unknowns of its pixel [k, n, b].
        by_common: derivative by the common unknowns [k, n, c]; None: there are none.
        own_prior: information [b, b] and right side [n, b] of a prior on the unknowns of every pixel.
        damping: adds damping * (trace + 1) to the diagonal of every block (Levenberg-Marquardt).
    """
    weighted = weight[..., None] * by_own
    own, own_right = np.einsum("kni,knj->nij", weighted, by_own), np.einsum("kni,kn->ni", weighted, residual)
    if own_prior is not None:
        own, own_right = own + own_prior[0], own_right + own_prior[1]
    if damping:
        own = own + damping * (np.trace(own, axis1=1, axis2=2) + 1.0)[:, None, None] * np.eye(own.shape[-1])
    covariance = np.linalg.inv(own)
    if by_common is None:
        n, b = own_right.shape
        return Eliminated(np.zeros((0, 0)), np.zeros(0), covariance, own_right, np.zeros((n, b, 0)))
    coupling = np.einsum("kni,kng->nig", weighted, by_common)
    solved = covariance @ coupling
    flat, flat_weight = by_common.reshape(residual.size, -1), weight.reshape(-1, 1)
    # einsum, for the threads of BLAS would spin on the other cores without any gain
    whole = np.einsum("mg,mh->gh", flat_weight * flat, flat) - np.einsum("nig,nih->gh", solved, coupling)
    right = (flat_weight[:, 0] * residual.ravel()) @ flat - np.einsum("nig,ni->g", solved, own_right)
    return Eliminated(whole, right, covariance, own_right, coupling)


def limit_steps(steps: np.ndarray, longest: np.ndarray | float) -> np.ndarray:
    """Shorten the steps [..., b] that are longer than `longest` [...], directions kept."""
    length = np.maximum(np.linalg.norm(steps, axis=-1), 1e-12)
    return steps * np.minimum(1.0, longest / length)[..., None]
