"""Errors that all pixels of a group share, such as a scan line or a tile of the image: estimated, and marginalised.

An offset of a scan line is one; that of a tile of the object is what the model of the fit lacks there: dust, a scratch,
a shape or a scattering law that is not quite the stated one. Where such an error is marginalised, what many pixels
agree in counts for no more than the error permits, and no parameter is moved to explain it.

Source: model discrepancy: Kennedy and O'Hagan, J. R. Stat. Soc. B 63 (2001) 425.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from helio_jax.arrays import robust_std
from helio_jax.robust import cauchy_weight

TILE = 6
"""Side of the tiles [pixels] within which residuals may be correlated."""
_CHANCE = 2.0
"""Standard deviations by which the scatter of groups must exceed that of noise for them to have errors of their own."""


class Groups(NamedTuple):
    """Groups of pixels.

    Attributes:
        number: of the group of every pixel [y, x].
        sums: 1 where a pixel belongs to a group, SciPy's sparse matrix [group, pixel].
    """

    number: np.ndarray
    sums: Any

    @property
    def n(self) -> int:
        """Number of groups."""
        return self.sums.shape[0]

    @classmethod
    def of(cls, number: np.ndarray) -> "Groups":
        """Make groups of their numbers [y, x]; numbers without a pixel are empty groups."""
        shape, ones = (int(number.max()) + 1, number.size), np.ones(number.size)
        return cls(number, csr_matrix((ones, (number.ravel(), np.arange(number.size))), shape))

    def total(self, images: np.ndarray) -> np.ndarray:
        """Sum images [..., y, x] over every group [..., group]."""
        flat = images.reshape(-1, self.number.size)
        return (self.sums @ flat.T).T.reshape(*images.shape[:-2], -1)

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Give every pixel the value of its group [..., group]: [..., y, x]."""
        return values[..., self.number]


def scan_lines(shape: tuple[int, int], slow_axis: int) -> Groups:
    """Group the pixels [y, x] of every scan line."""
    return Groups.of(np.indices(shape)[slow_axis])


def tiles(is_object: np.ndarray, side: int) -> Groups:
    """Group pixels [y, x] into tiles of so many pixels a side; groups of odd number lie on the object."""
    row, column = np.indices(is_object.shape) // side
    return Groups.of(2 * (row * (column.max() + 1) + column) + is_object)


def whitened(weighted: np.ndarray, inverse: np.ndarray, std: np.ndarray, groups: Groups) -> np.ndarray:
    """Whiten images [..., detector, y, x] that are divided by their noise, for errors of whole groups.

    With u = 1 / sigma of a group's pixels the covariance of the divided data is 1 + L^2 u u^T; its inverse square root
    is 1 - c u u^T with c = (1 - (1 + L^2 |u|^2)^-1/2) / |u|^2.

    Args:
        weighted: data over their noise.
        inverse: of the noise, 0 where there are no data [detector, y, x].
        std: standard deviation L of the groups' errors [detector, group].
        groups: of the pixels.
    """
    if not np.any(std):
        return weighted
    size = groups.total(inverse**2)
    c = (1.0 - 1.0 / np.sqrt(1.0 + std**2 * size)) / np.maximum(size, 1e-300)
    return weighted - inverse * groups.spread(c * groups.total(weighted * inverse))


def group_means(misfit: np.ndarray, weight: np.ndarray, groups: Groups) -> tuple[np.ndarray, np.ndarray]:
    """Average a misfit [detector, y, x] over groups.

    Args:
        misfit: anything where the weight is 0.
        weight: of the pixels, the inverse of the variance [detector, y, x].
        groups: of the pixels.

    Returns:
        Means and sums of the weights [detector, group].
    """
    total = groups.total(weight)
    return groups.total(np.where(weight > 0.0, weight * misfit, 0.0)) / np.maximum(total, 1e-300), total


def common_std(mean: np.ndarray, total: np.ndarray, is_sure: bool = False) -> np.ndarray:
    """Estimate the standard deviation of the errors of groups [detector] from their means.

    Args:
        mean, total: from `group_means`; groups without weight do not count [detector, group].
        is_sure: whether it is 0 unless the means scatter by more than their noise does by chance.
    """
    out = []
    for value, weight in zip(mean, total, strict=True):
        known = weight > 1e-200
        excess = 0.0
        if known.sum() > 3:
            noise = float(np.median(1.0 / weight[known]))
            excess = float(robust_std(value[known] - np.median(value[known]))) ** 2 - noise
            if is_sure and excess < _CHANCE * noise * np.sqrt(2.0 / known.sum()):
                excess = 0.0
        out.append(np.sqrt(max(excess, 0.0)))
    return np.array(out)


def enlargement(
    shapes: list[tuple[int, ...]],
    weights: list[np.ndarray],
    jacobian: np.ndarray,
    residual: np.ndarray,
    inverse: np.ndarray,
    limit: float,
) -> tuple[float, float]:
    """Compute chi-square per datum, and the factor by which correlated residuals enlarge the standard deviations.

    Residuals may be correlated within tiles of `TILE` x `TILE` pixels, all detectors: the covariance of J^T r is then
    the sum over tiles of (J^T r)(J^T r)^T, to be compared with J^T J. The factor is the root of the mean ratio.

    Args:
        shapes: (detector, y, x) of the scans.
        weights: robust weights of the data used, per scan [datum].
        jacobian, residual: of the data of all scans, weighted [datum, unknown], [datum].
        inverse: covariance of the unknowns before it is enlarged.
        limit: of the robust weights [standard deviations].

    Source: White, Econometrica 48 (1980) 817; clusters: Liang and Zeger, Biometrika 73 (1986) 13.
    """
    weight = np.concatenate(weights)
    effective = max(float(weight.sum()) - np.trace(np.eye(len(inverse)) - inverse), 1.0)
    # robust weights make even the mean square of normal noise less than 1
    node, share = np.polynomial.hermite_e.hermegauss(40)
    normal = cauchy_weight(node, limit)
    expected = float(np.sum(share * normal * node**2) / np.sum(share * normal))
    chi_square = float(residual @ residual) / effective / expected
    total, first = np.zeros_like(inverse), 0
    for k, ny, nx in shapes:
        rows = slice(first, first + k * ny * nx)
        first = rows.stop
        score = (jacobian[rows] * residual[rows, None]).reshape(k, ny, nx, -1).sum(0)
        for i in range(0, ny, TILE):
            for j in range(0, nx, TILE):
                of_tile = score[i : i + TILE, j : j + TILE].sum((0, 1))
                total += np.outer(of_tile, of_tile)
    ratio = np.trace(inverse @ total) / max(np.trace(inverse @ (jacobian.T @ jacobian)), 1e-12)
    return chi_square, float(np.sqrt(ratio))
