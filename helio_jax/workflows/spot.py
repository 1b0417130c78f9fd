"""Measure and draw the beam's spot: `helio spot`."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from helio_jax.errors import SceneError
from helio_jax.figures.spot import measure_spot, save_spots
from helio_jax.scene.scene import Scene
from helio_jax.trace.source import footprint

SPOT_RAYS = 32768
"""Number of rays."""


def draw_spot(scene: Scene, heights: Sequence[float], path: str | Path | None, seed: int = 1) -> list[dict[str, float]]:
    """Measure the beam's spot on planes at `heights` [um] above the substrate; draw it if `path` is given.

    Raises:
        SceneError: a height is not finite, or not below the plate.
    """
    if wrong := [h for h in heights if not math.isfinite(h)]:
        raise SceneError(f"heights must be finite numbers of um, got {wrong[0]:g}: correct or remove it")
    if wrong := [h for h in heights if h >= scene.sample_distance]:
        limit = f"{scene.sample_distance:g} um above the substrate"
        raise SceneError(f"heights must be below the plate, which is {limit}, got {wrong[0]:g} um: lower them")
    points = footprint(scene.instrument, np.array(heights), SPOT_RAYS, seed, scene.read_rays())
    spots = [{"height_um": float(h), **measure_spot(p)} for h, p in zip(heights, points, strict=True)]
    if path is not None:
        save_spots(points, spots, f"{scene.name}: the beam's spot", Path(path))
    return spots
