"""Heights of steps along long edges, part by part: how high a wall is at each place, not on average.

A fit holds its masks fixed in every iteration and learns little of them. Beside a wall it sees a surface in few images,
lit by what the wall scatters: there its error is tens of micrometres, and goes on beyond the band. Parts of the band
say what the height is at each place, to some micrometres.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from helio_jax.inverse.mask_edges import Edge
from helio_jax.inverse.mask_steps import measure_edge, scan_of
from helio_jax.inverse.step_records import Steps
from helio_jax.micrograph import MicrographStack

PART = 12
"""Shortest part of an edge that is measured [pixels]."""


def steps_in_parts(found: Steps, stack: MicrographStack) -> list[Steps]:
    """Measure long steps again in parts of their edges, of `PART` pixels and more; those of each step together.

    Of what is common to the parts of a step, the distance from which it is seen is in the error of the whole step only.
    Parts that show no height are left out.

    Args:
        found: steps, from `find_steps`.
        stack: micrographs.
    """
    scan, _ = scan_of(stack)
    out = []
    for step in found.steps:
        steps, bands = [], []
        ends = np.array([step.start, step.end])
        n = int(np.hypot(*(ends[1] - ends[0])) // (PART * scan.images.side))
        if not step.is_used or step.above == step.below or n < 2:
            continue
        level = found.patches[step.below].level_um
        places = ends[0] + (ends[1] - ends[0]) * np.linspace(0.0, 1.0, n + 1)[:, None]
        for start, end in pairwise(places):
            part = measure_edge(len(steps) + 1, (Edge(start, end, ()), 0.0), scan, float(np.nan_to_num(level)))
            if part.step.is_used:
                steps.append(replace(part.step, above=step.above, below=step.below))
                bands += part.bands
        if len(steps) > 1:
            out.append(replace(found, steps=tuple(steps), bands=tuple(bands)))
    return out
