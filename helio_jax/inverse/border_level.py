"""The level of the signal on a flat border: where it is off, fits and searches start from there.

Wrong gains, background that nobody subtracted, wrong directions and a dark substrate all bring it off. By the stated
instrument all data of such a detector are outliers: the photometric solution takes them for slopes, and a robust fit
from there can rest in heights of three times the true ones.
"""

import numpy as np

from helio_jax.arrays import border_mask
from helio_jax.forward.form_factor import substrate_signal
from helio_jax.forward.laws import level_ratio
from helio_jax.forward.optics import Optics
from helio_jax.inverse.parameters import LawPrior
from helio_jax.inverse.settings import ReconstructSettings

OFF = 0.05
"""Levels count as right where no detector's is off by a larger share: multiple scattering and masks of high objects do
as much."""
MOST = 5.0
"""Levels that are off by a larger factor, or not positive, count as off by this one."""


def border_levels(
    signal: np.ndarray, optics: Optics, settings: ReconstructSettings, law: LawPrior | None = None
) -> np.ndarray:
    """Compute the level of a flat border's signal over that of the level substrate [detector].

    1 in every detector where the border is free, or all levels are right (`OFF`); 1 in a detector without data there.

    Args:
        signal: in units of the beam, over the albedo [detector, y, x], NaN where not observed.
        optics: as stated.
        settings: width and kind of the border.
        law: whose mean the substrate scatters by; None: the cosine law.
    """
    none = np.ones(len(signal))
    if settings.border != "flat":
        return none
    of_border = signal[:, border_mask(signal.shape[1:], settings.border_fraction)]  # type: ignore[arg-type]
    expected = substrate_signal(optics) * (1.0 if law is None else level_ratio(law.mean, optics))
    found = none.copy()
    for i, data in enumerate(of_border):
        known = data[np.isfinite(data)]
        if known.size:
            found[i] = np.clip(np.median(known) / expected[i], 1.0 / MOST, MOST)
    return found if np.abs(found - 1.0).max() > OFF else none
