"""Height maps of a formula, as a beam of any incidence sees them."""

import numpy as np

from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.reconstruction import Reconstruction

PITCH = 20.0


def make_rec(height, n=(101, 101), incidence=0.0, noise=0.0, is_valid=None, pitch=PITCH) -> Reconstruction:
    """Return a height map of a formula of the surface's own x, y, solved along the beam."""
    detector = Detector(name="d", polar_deg=45.0, half_angle_deg=10.0)
    instrument = Instrument(
        beam=Beam(incidence_deg=incidence), plate=Plate(working_distance_um=3000.0), detector=(detector,)
    )
    x, y = ((np.arange(k) - (k - 1) / 2) * pitch for k in reversed(n))
    grid_x, grid_y = np.meshgrid(x, y)
    tx, _ = instrument.beam_shift
    z = np.zeros(n)
    for _ in range(200):  # a fixed point: the height seen at (X, Y) is that at x = X - z tan t
        z = 0.5 * z + 0.5 * height(grid_x - z * tx, grid_y)
    z = z + noise * np.random.default_rng(5).standard_normal(n)
    valid = np.ones(n, bool) if is_valid is None else is_valid
    up = np.zeros((*n, 3)) + [0.0, 0.0, 1.0]
    return Reconstruction(z, x, y, instrument, "linear", up, np.ones(n), valid, np.where(valid, 0, 1))
