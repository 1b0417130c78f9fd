"""The true surface for scores: of a scene, or another height map. Never used by a fit."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from helio_jax.arguments import checked
from helio_jax.errors import InputFileError, SceneError
from helio_jax.formats.hdf5 import read_height
from helio_jax.formats.history import history_of, scene_of
from helio_jax.formats.suffixes import HDF5_SUFFIXES
from helio_jax.instrument import Beam
from helio_jax.micrograph import Micrographs
from helio_jax.reconstruction import Reconstruction
from helio_jax.scene.shapes import SpheresSample
from helio_jax.scene.surfaces import first_hit_spheres
from helio_jax.scores.metrics import Region, Truth
from helio_jax.scores.metrics import fit_center as fit_sphere_center
from helio_jax.trace.intersect import MISS, Intersector
from helio_jax.trace.run import first_hits
from helio_jax.workflows.scene_errors import explain_errors
from helio_jax.workflows.scene_file import SceneFile, load_scene, read_reconstruction, resolved

_SHOWN = 3
"""So many differences of two scenes are named."""
_ODD = 0.05
"""Relative difference of two heights of a sample that is a mistake, not a raster that misses the top."""
SUBSTRATE_RATIO = 1.35
"""Default inner radius of the scored substrate, over the radius of the scored region."""


@checked
def true_height(scene: SceneFile, rec: Reconstruction) -> Truth:
    """Compute the true first hit for every pixel of a reconstruction's raster (see `true_surface`).

    Along the beam, or along the direction from which the raster of several scans sees the sample.

    Example:
        >>> hx.true_height(scene, rec).height
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


def simulated_scene(rec: Micrographs | Reconstruction, path: Path) -> SceneFile:
    """Return the scene in the history of simulated data, with files where it names them, relative ones beside `path`.

    Raises:
        InputFileError: not simulated, or this version does not accept the scene.
    """
    history = history_of(rec, str(path))
    try:
        scene = SceneFile.model_validate(dict(history.scene), context={"read_reconstruction": read_reconstruction})
    except ValidationError as e:
        raise InputFileError(explain_errors(f"{path}: scene in its history", e, SceneFile, history.scene)) from None
    return scene.with_base_dir(path.absolute().parent)


def other_sample(path: Path, rec: Reconstruction) -> str | None:
    """Say in which values the sample and the beam of a scene differ from those that were simulated; None: in none.

    Of data that were not simulated nothing is known, and nothing is said.
    """
    before = scene_of(rec)
    if before is None:
        return None
    now = resolved(load_scene(path))
    values = [dict(_values({key: tables.get(key, {}) for key in ("sample", "beam")})) for tables in (now, before)]
    keys = [key for key in dict.fromkeys([*values[0], *values[1]]) if values[0].get(key) != values[1].get(key)]
    if not keys:
        return None
    shown = [f"{key} {values[0].get(key)!r} instead of {values[1].get(key)!r}" for key in keys[:_SHOWN]]
    more = f" and {len(keys) - _SHOWN} more" if len(keys) > _SHOWN else ""
    return f"{path} is not what was simulated: {', '.join(shown)}{more}"


def odd_height(truth: Truth) -> str | None:
    """Say that the height which errors are fractions of is not that of the true surface; None: it is."""
    height = truth.region.height if truth.region else None
    reached = float(np.nanmax(np.abs(truth.height)))
    if height is None or abs(height - reached) <= _ODD * height:
        return None
    return f"truth.height_um is {height:g} um, the true heights reach {reached:.0f} um: errors in % are of the former"


def _values(node: Any, above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted keys and values of nested tables and lists; of files their names without folders."""
    pairs = node.items() if isinstance(node, Mapping) else enumerate(node) if isinstance(node, list) else None
    if pairs is None:
        yield above, Path(node).name if above.endswith(".file") and isinstance(node, str) else node
        return
    for key, value in pairs:
        yield from _values(value, f"{above}.{key}" if above else str(key))


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
