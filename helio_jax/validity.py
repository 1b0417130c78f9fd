"""The one rule of `is_valid`: its reasons, its limits and its words, for every method, command, file and report.

The reconstruction applies these limits (inverse.quality, inverse.verdict); whatever prints or stores the word "valid"
prints or stores `VALID_RULE` with it.
"""

import numpy as np

MIN_IMAGES = 3
"""Images needed per pixel by the photometric methods: three unknowns (albedo times normal)."""
FACET_IMAGES = 2
"""Informative images that fix the two slopes of a facet of known albedo."""
EXPLAINED = 3.0
"""Mean square residual of a pixel and its eight neighbours, in that of most pixels and at least 1, up to which the
model of a fit explains them: noise alone reaches it in one pixel of a million."""
FLOATING = 0.2
"""A region is floating when its level is uncertain by more than this share of its step to the substrate."""
CHI_SQUARE_LIMIT = 2.5
"""Mean square deviation of a pixel and its eight neighbours, in all detectors, from which on the data contradict the
map: noise alone reaches it in one pixel of 50 000 (three detectors)."""
MAX_CONTRADICTED = 0.05
"""Largest share of contradicted pixels, among those that nothing else makes invalid, of a height map that its data do
not contradict as a whole; regions that are contradicted as a whole count with all of their pixels."""
MAX_CONTRADICTED_REGION = 0.1
"""Largest share of contradicted pixels of a region that depth jumps separate from the rest and that the data do not
contradict as a whole: what is fitted of it, its level included, leans on all of its data."""

MEANINGS = {
    "valid": "",
    "too few images": (
        f"fewer than {MIN_IMAGES} images show the pixel ({FACET_IMAGES} for refine, which takes the albedo as smooth)"
    ),
    "masked in too many detectors": f"fewer than {FACET_IMAGES} images are informative: the others are masked there",
    "depth jump": (
        "refine cuts the surface there, or its fit does not explain the data of the 3 x 3 pixels (mean square residual "
        f"above {EXPLAINED:g}); linear and nearfield do not mark jumps"
    ),
    "outside the data": "the pixel was not recorded",
    "floating": (
        f"the level of the region is uncertain by more than {FLOATING:.0%} of its step to the largest region, or "
        "another level explains the data as well"
    ),
    "contradicts the data": (
        "the mean square of the deviations of the data from micrographs traced on the map, in standard deviations, is "
        f"above {CHI_SQUARE_LIMIT:g} over the 3 x 3 pixels (above {CHI_SQUARE_LIMIT:g} times its median where "
        f"instrument or calibration are uncertain); or this holds for more than {MAX_CONTRADICTED_REGION:.0%} of a "
        "region between depth jumps that contains the pixel"
    ),
}
"""What each reason means, in words."""
REASONS = tuple(MEANINGS)
"""Meaning of the integers of `Reconstruction.reason`."""
VALID_RULE = (
    f"a height is valid if enough images show its pixel ({MIN_IMAGES}; {FACET_IMAGES} for refine), {FACET_IMAGES} of "
    "them unmasked, no depth jump was found there, its level is determined, and micrographs traced on the map agree "
    "with the data"
)
"""What `is_valid` states, in words: all reasons of `MEANINGS` denied."""
CONTRADICTED = "the data contradict this height map: do not trust it"
NONE_VALID = "no height is valid: do not trust this height map"


def contradicted_share(reason: np.ndarray) -> float:
    """Compute the share of pixels that contradict the data among those that nothing else makes invalid."""
    is_contradicted = reason == REASONS.index("contradicts the data")
    return float(np.sum(is_contradicted) / max(1, np.sum(is_contradicted | (reason == 0))))
