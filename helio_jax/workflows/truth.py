"""The true surface for scores: of a scene, or another height map. Never used by a fit."""

from pathlib import Path

import numpy as np

from helio_jax.errors import SceneError
from helio_jax.formats.hdf5 import read_height
from helio_jax.formats.suffixes import HDF5_SUFFIXES
from helio_jax.instrument import Beam
from helio_jax.reconstruction import Reconstruction
from helio_jax.scene.shapes import SpheresSample
from helio_jax.scene.surfaces import first_hit_spheres
from helio_jax.scores.metrics import Region, Truth
from helio_jax.scores.metrics import fit_center as fit_sphere_center
from helio_jax.trace.intersect import MISS, Intersector
from helio_jax.trace.run import first_hits
from helio_jax.workflows.scene_file import SceneFile, load_scene

SUBSTRATE_RATIO = 1.35
"""Default inner radius of the scored substrate, over the radius of the scored region."""


def true_height(scene: SceneFile, rec: Reconstruction) -> Truth:
    """Compute the true first hit for every pixel of a reconstruction's raster (see `true_surface`).

    Along the beam, or along the direction from which the raster of several scans sees the sample.
    """
    return true_surface(
        scene, rec.raster_x, rec.raster_y, rec.instrument.beam if rec.instrument.has_several_beams else None
    )


def true_surface(scene: SceneFile, x: np.ndarray, y: np.ndarray, beam: Beam | None = None) -> Truth:
    """Compute the true first hit of the axis of a beam (default: the scene's) for positions x [x] and y [y], um.

    Raises:
        SceneError: the beam misses the sample in some pixel.
    """
    grid_x, grid_y = np.meshgrid(x, y)
    instrument = scene.instrument.model_copy(update={"beam": beam}) if beam else scene.instrument
    hits = first_hits(Intersector(scene.build_body()), instrument, grid_x.ravel(), grid_y.ravel())
    n_missed = int(np.sum(hits.surface == MISS))
    if n_missed:
        raise SceneError(f"the beam misses the sample in {n_missed} pixels: enlarge sample.size_um or reduce the scan")
    height = hits.point[:, 2].reshape(grid_x.shape)
    return Truth(height, hits.normal.reshape(*grid_x.shape, 3), _region(scene, float(height.max())))


def _region(scene: SceneFile, top: float) -> Region | None:
    """Return the scored region of a scene's table [truth], if it defines one."""
    t = scene.truth
    if t.region_radius_um is None:
        return None
    return Region(
        center=t.region_center_um,
        radius=t.region_radius_um,
        substrate_radius=t.substrate_radius_um or SUBSTRATE_RATIO * t.region_radius_um,
        height=t.height_um or top,
    )


def load_truth(path: str | Path, rec: Reconstruction, *, fit_center: bool = False) -> Truth:
    """Load the truth from a scene file, or from another reconstruction on the same raster.

    Args:
        path: scene (.toml) or height map (.h5).
        rec: reconstruction to be scored.
        fit_center: fit the position of the scene's only sphere first, as for measured data.

    Raises:
        InputFileError: the file is missing, damaged or of another kind, or on another raster.
        SceneError: `fit_center` without a scene of one sphere and a scored region.
    """
    if Path(path).suffix.lower() in HDF5_SUFFIXES:
        other = read_height(path)
        return Truth(other.height, other.normals)
    scene = load_scene(path)
    return _fitted_truth(path, scene, rec) if fit_center else true_height(scene, rec)


def _fitted_truth(path: str | Path, scene: SceneFile, rec: Reconstruction) -> Truth:
    """Return the truth of a scene's sphere at its best-fitting position."""
    sample, region = scene.sample, _region(scene, 0.0)
    if not isinstance(sample, SpheresSample) or len(sample.spheres) != 1 or sample.is_placed or region is None:
        raise SceneError(
            f"{path}: fitting a centre needs a scene with one sphere, without sample.scale, rotate_deg and "
            "translate_um, and with truth.region_radius_um"
        )
    grid_x, grid_y = np.meshgrid(rec.raster_x, rec.raster_y)
    (_, _, z, radius), shift = sample.sphere_array[0], rec.instrument.beam_shift

    def sphere_at(x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
        return first_hit_spheres(grid_x, grid_y, np.array([[x, y, z, radius]]), shift)

    found = fit_sphere_center(rec, lambda x, y: sphere_at(x, y)[0], region)
    return Truth(*sphere_at(*found.center), found)
