"""Write micrographs for other programs; the suffix selects the format.

`.mat`: the reference simulator's layout (`im.single`, `im.multiple`, `param`, `beam_param`). `helio import` reads it
back: counts bit for bit, positions to rounding. Frame: matlab_reference.py. Not written: rotations of apertures (the
layout has no field) and `detector_vector` (constant directions, which the layout's users assume).
"""

import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.errors import SceneError
from helio_jax.formats.safe import atomic_path
from helio_jax.micrograph import MicrographSet, MicrographStack

_SOURCES = {"uniform": "Uniform", "gaussian": "Gaussian", "pencil": "Infinite"}


def export(obj: Any, path: str | os.PathLike, view: int | None = None) -> list[str]:
    """Write an object to a foreign file.

    Args:
        obj: result of `read`.
        path: target file.
        view: index of the stack in a set, from 0; required for several stacks.

    Returns:
        Data of the object that the format cannot hold, each with a reason.

    Raises:
        SceneError: the format is unknown, or cannot hold this object.
    """
    n = len(obj.stacks) if isinstance(obj, MicrographSet) else 1
    if (view is None and n > 1) or not 0 <= (view or 0) < n:
        given = "" if view is None else f", got {view}"
        raise SceneError(f"{path}: holds one scan, the set has {n}: give --view 0 to {n - 1}{given}")
    if isinstance(obj, MicrographSet):
        obj = obj.stacks[view or 0]
    kind = Path(path).suffix.lower()
    if kind != ".mat" or not isinstance(obj, MicrographStack):
        raise SceneError(
            f"{path}: a {type(obj).__name__} cannot be written as {kind or 'a file without suffix'!r}: known is .mat "
            "for micrographs (the reference simulator's layout)"
        )
    tree = reference_tree(obj, str(path))
    from scipy.io import savemat

    with atomic_path(path) as part:
        savemat(part, tree, do_compression=True)
    return _left_out(obj)


def _left_out(stack: MicrographStack) -> list[str]:
    """List data of a stack that the reference simulator's layout does not hold."""
    out = []
    if stack.effuse is not None:
        ratio = float(stack.effuse.sum() / stack.counts.sum()) if stack.counts.sum() > 0 else 0.0
        out.append(f"effuse, counts of the effusive beam ({ratio:.1%} of the others): no field in this layout")
    if stack.plate is not None:
        out.append("plate, counts from plate bounces: included in single and multiple, not separately")
    if stack.by_order is not None and len(stack.by_order) > 2:
        out.append(f"orders 2 to {len(stack.by_order)} separately: multiple is their sum")
    return out


def reference_tree(stack: MicrographStack, path: str = "") -> dict[str, dict[str, Any]]:
    """Convert a stack to the variables of the reference simulator's file.

    Args:
        stack: simulated on a raster, with scattering orders whose sum is the counts.
        path: for messages.

    Raises:
        SceneError: the layout cannot hold this stack.
    """
    _check(stack, path)
    instrument, beam = stack.instrument, stack.instrument.beam
    t = math.radians(beam.incidence_deg)
    orders = {"single": stack.by_order[0], "multiple": stack.multiple}  # type: ignore[index]
    im: dict[str, Any] = {name: _cells(_compact(image[:, :, ::-1])) for name, image in orders.items()}  # type: ignore[index]
    im["raster_movement_x"] = pitch(stack.x) * math.cos(t) / 1000
    im["raster_movement_y"] = pitch(stack.y) / 1000
    im["helio_center_um"] = np.array([0.5 * (a[0] + a[-1]) for a in (stack.x, stack.y)])
    apertures = instrument.apertures()
    param = {
        "detector_position": _cells([np.array([a.center[0], 0.0 - a.center[1]]) / 1000 for a in apertures]),
        "detector_axes": _cells([2 * np.array(a.semi_axes) / 1000 for a in apertures]),
        "z_sample_to_detector": instrument.sample_distance / 1000,
        "rays_per_pixel": stack.n_rays,
    }
    beam_param = {
        "init_angle": beam.incidence_deg,
        "source_size": beam.source_size_mrad / 1000,
        "source_model": _SOURCES[beam.source],
        "pinhole_r": beam.pinhole_radius_um / 1000,
        "pinhole_c": np.array([round(-instrument.working_distance * math.tan(t) / 1000, 8), 0.0, 0.0]),
    }
    return {"im": im, "param": param, "beam_param": beam_param}


def _check(stack: MicrographStack, path: str) -> None:
    """Check that the reference simulator's layout can hold a stack."""
    n, ny, nx = stack.shape
    if stack.by_order is None or len(stack.by_order) < 2 or stack.n_rays is None:
        raise SceneError(
            f"{path}: this layout holds single and multiple scattering separately, which {stack.name!r} does not"
        )
    if stack.noise != "expected" and not np.array_equal(stack.by_order.sum(0), stack.counts):
        raise SceneError(
            f"{path}: the scattering orders of {stack.name!r} are expectations, its counts have noise: export it "
            "without noise, or trace with --estimator analog"
        )
    if stack.instrument.beam.azimuth_deg != 0.0:
        raise SceneError(
            f"{path}: in this layout the beam travels along x, here beam.azimuth_deg is "
            f"{stack.instrument.beam.azimuth_deg:g}: rotate the scene"
        )
    if stack.positions is not None:
        raise SceneError(f"{path}: this layout holds rasters, {stack.name!r} is a list of {nx} positions")
    if n < 2 or min(ny, nx) < 2:
        raise SceneError(
            f"{path}: this layout holds rasters of at least 2 x 2 pixels and 2 detectors, got {nx} x {ny} and {n}"
        )


def _compact(images: np.ndarray) -> list[np.ndarray]:
    """Split images [detector, y, x]; integer counts are converted to the smallest unsigned type."""
    if np.array_equal(images, np.round(images)) and images.min() >= 0 and images.max() < 2**32:
        kind = next(k for k in (np.uint8, np.uint16, np.uint32) if images.max() <= np.iinfo(k).max)
        return list(images.astype(kind))
    return list(images)


def _cells(items: list[np.ndarray]) -> np.ndarray:
    """Convert to a MATLAB cell array (one row)."""
    cells = np.empty((1, len(items)), dtype=object)
    for i, item in enumerate(items):
        cells[0, i] = item
    return cells
