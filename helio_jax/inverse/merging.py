"""Piecewise-constant segmentation of a noisy map by region merging.

Every pixel begins as a region. The two neighbouring regions whose union costs least per unit of their common border are
merged, until every union costs more than a given penalty: the functional of Mumford and Shah for constant pieces. Sharp
borders stay where they are, and no number of regions is given.
"""

import heapq

import numpy as np

from helio_jax.forward.surface import along
from helio_jax.inverse.edges import ranked


def merge_regions(value: np.ndarray, weight: np.ndarray, penalty: float) -> np.ndarray:
    """Number the region of every pixel [y, x], the largest one 0.

    The cost of a union is the increase of the weighted sum of squares about the means of the regions.

    Args:
        value: the map [y, x].
        weight: inverse variance of every value [y, x]; a value of weight 0 goes with its neighbours.
        penalty: cost of a unit of border, the side of a pixel.

    Source: Koepfler, Lopez and Morel, SIAM J. Numer. Anal. 31 (1994) 282.
    """
    n = value.size
    pixel = np.arange(n).reshape(value.shape)
    total, moment = weight.ravel().tolist(), (weight * value).ravel().tolist()
    owner = list(range(n))
    border: list[dict[int, int]] = [{} for _ in range(n)]
    for axis in (0, 1):
        before, after = along(pixel, axis)
        for a, b in zip(before.ravel().tolist(), after.ravel().tolist(), strict=True):
            border[a][b] = border[b][a] = 1

    def cost(a: int, b: int) -> float:
        """Increase of the sum of squares by a union, per unit of its border."""
        both = total[a] + total[b]
        if total[a] <= 0.0 or total[b] <= 0.0:
            return 0.0
        apart = moment[a] / total[a] - moment[b] / total[b]
        return total[a] * total[b] / both * apart**2 / border[a][b]

    waiting = [(cost(a, b), a, b) for a in range(n) for b in border[a] if a < b]
    heapq.heapify(waiting)
    while waiting:
        least, a, b = heapq.heappop(waiting)
        if least > penalty:
            break
        if owner[a] != a or owner[b] != b or b not in border[a] or least != cost(a, b):
            continue  # of regions that have changed since
        if len(border[a]) < len(border[b]):
            a, b = b, a
        owner[b] = a
        total[a], moment[a] = total[a] + total[b], moment[a] + moment[b]
        for other, length in border[b].items():
            del border[other][b]
            if other != a:
                border[a][other] = border[other][a] = border[a].get(other, 0) + length
        for other in border[a]:
            heapq.heappush(waiting, (cost(a, other), a, other))
    root = np.array(owner)
    while np.any(root != root[root]):
        root = root[root]
    return ranked(root).reshape(value.shape)
