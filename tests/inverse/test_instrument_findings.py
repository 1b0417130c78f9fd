"""Where edges are cut while the instrument is first fitted, and how what was found is named."""

import numpy as np
import pytest

from helio_jax.reconstruct.findings import _plain
from helio_jax.reconstruct.model import Surface
from helio_jax.reconstruct.shadows import shadow_edges


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_edges_are_cut_behind_rims_only(way):
    """A hill that falls steeply along the beam and changes all images there; the same steep rise before it stays.

    Catches the beam's direction reversed, edges of the other axis, and cuts where the images show no wall.
    """
    height, slope = np.zeros((20, 30)), np.zeros((20, 30))
    slope[:, 8:10], slope[:, 20:22] = 3.0, -3.0
    signal = np.ones((3, 20, 30))
    signal[:, :, 10:20] = 2.0
    surface = Surface(height, slope, np.zeros_like(slope))
    found = shadow_edges(signal, np.full(signal.shape, 1e-3), surface, (0.577 * way, 0.0), 1)
    columns = set(np.flatnonzero(found.any(0)))
    right, wrong = (set(range(18, 23)), set(range(6, 12)))[:: 1 if way > 0 else -1]
    assert columns & right and not columns & wrong and found[:, list(columns)].all()
    assert not shadow_edges(signal, np.full(signal.shape, 1e-3), surface, (0.577 * way, 0.0), 0).any()
    assert not shadow_edges(np.ones_like(signal), np.full(signal.shape, 1e-3), surface, (0.577 * way, 0.0), 1).any()


def test_parameters_have_plain_names():
    """Catches polar angle and azimuth exchanged, and a detector named by its number."""
    names = "forward", "left"
    shown = {
        "aim[1, 0]": "polar left",
        "aim[0, 1]": "azimuth forward",
        "tilt[1]": "tilt y",
        "distance[0]": "distance",
        "drift[1, 3]": "drift left 3",
        "log_gain[0]": "log_gain forward",
        "unseen[]": "unseen",
    }
    assert {name: _plain(name, names) for name in shown} == shown
