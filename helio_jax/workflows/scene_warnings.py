"""Probable mistakes of a scene that show when its sample is built: where the beam goes, how large the structure is."""

import numpy as np

from helio_jax.scene.body import Body
from helio_jax.trace.intersect import MISS, Hits, Intersector
from helio_jax.trace.run import first_hits
from helio_jax.workflows.scene_file import SceneFile

MAX_BEAMS = 10_000
"""Largest number of beam positions whose hits are computed."""
SMALL_SHARE = 0.05
"""A structure smaller than this share of the raster is probably given in the wrong unit."""
_FLAT = 1e-9
"""Height of the substrate's plane, over the sample's size."""
ANALOG_SHARE = 0.1
"""Fewer analog rays than this share of scan.atoms_per_pixel are probably a mistake."""


def scene_warnings(scene: SceneFile, body: Body) -> list[str]:
    """List probable mistakes: a beam that misses, a structure that is too small, rays that do not fit the estimator.

    Args:
        scene: the scene.
        body: its sample as built.
    """
    x, y = _beams(scene)
    hits = first_hits(Intersector(body), scene.instrument, x, y)
    found = [*_of_misses(hits, x, y, body), *_of_size(scene, body)] or _of_substrate(hits, x, y, body)
    return [*_of_rays(scene), *found]


def _of_rays(scene: SceneFile) -> list[str]:
    """Compare the number of rays with the atoms that the counts stand for."""
    rays, atoms = scene.trace.rays, scene.scan.atoms_per_pixel
    if scene.trace.estimator != "analog" or rays >= ANALOG_SHARE * atoms:
        return []
    return [
        f"trace.rays = {rays}: the analog estimator counts these {rays} atoms per pixel, not scan.atoms_per_pixel = "
        f"{atoms:g}: set trace.rays = {atoms:g}, or trace.estimator = 'expected'"
    ]


def _beams(scene: SceneFile) -> tuple[np.ndarray, np.ndarray]:
    """Return a regular selection of beam positions x, y, um."""
    ny, nx = scene.image_shape
    step = max(1, -(-nx * ny // MAX_BEAMS))
    return scene.points(np.arange(0, nx * ny, step))


def _of_misses(hits: Hits, x: np.ndarray, y: np.ndarray, body: Body) -> list[str]:
    """Find beam positions whose beam meets nothing."""
    is_miss = hits.surface == MISS
    if not is_miss.any():
        return []
    low, high = body.bounds
    place = (
        f"the sample reaches from x = {low[0]:g}, y = {low[1]:g} to {high[0]:g}, {high[1]:g} um, the beam positions "
    )
    place += f"from {x.min():g}, {y.min():g} to {x.max():g}, {y.max():g} um"
    share = "none" if is_miss.all() else f"only {1.0 - is_miss.mean():.1%}"
    remedy = "check sample.unit, sample.translate_um and scan.center_um"
    return [f"the beam meets the sample at {share} of the beam positions: {place}: {remedy}"]


def _of_substrate(hits: Hits, x: np.ndarray, y: np.ndarray, body: Body) -> list[str]:
    """Find out whether the beam meets only the substrate's plane z = 0, though something stands on it or is cut in."""
    low, high = body.bounds
    flat = _FLAT * max(1.0, float(np.ptp(body.bounds, axis=0).max()))
    if max(-low[2], high[2]) <= flat or np.abs(hits.point[:, 2]).max() > flat:
        return []
    place = f"the beam positions reach from x = {x.min():g}, y = {y.min():g} to {x.max():g}, {y.max():g} um"
    return [
        f"the beam meets only the substrate, not what stands on it ({low[2]:g} to {high[2]:g} um high): {place}: check "
        "sample.translate_um and scan.center_um"
    ]


def _of_size(scene: SceneFile, body: Body) -> list[str]:
    """Compare the structure, which is all that does not lie in the substrate's plane z = 0, with raster and pixel."""
    spacing = scene.scan.spacing
    faces = body.triangles
    is_flat = np.abs(faces[..., 2]).max(1, initial=0.0) <= _FLAT * max(1.0, float(np.ptp(body.bounds, axis=0).max()))
    corners = faces[~is_flat].reshape(-1, 3)[:, :2]
    center, radius = body.spheres[:, :2], body.spheres[:, 3:]
    points = np.concatenate([corners, center - radius, center + radius])
    if spacing is None or not len(points) or scene.sample.is_tilted:
        return []
    size = float(np.ptp(points, axis=0).max())
    x, y = scene.points(np.arange(int(np.prod(scene.image_shape))))
    field = float(max(np.ptp(x), np.ptp(y)))
    if size >= spacing and size >= SMALL_SHARE * field:
        return []
    limit = f"less than a pixel ({spacing:g} um)" if size < spacing else f"less than {SMALL_SHARE:.0%} of the raster"
    remedy = "check sample.unit and sample.scale, or choose a smaller scan.pixel_size_um"
    return [f"the sample's structure is {size:g} um across, {limit}, which is {field:g} um wide: {remedy}"]
