"""Write simulated micrographs in the reference simulator's layout (`im.single`, `im.multiple`, `param`, `beam_param`).

`helio import` reads it back: counts bit for bit, positions to rounding. Frame: matlab_reference.py. Not written:
rotations of apertures (the layout has no field) and `detector_vector` (constant directions, which the layout's users
assume).
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.errors import SceneError
from helio_jax.formats.write_arrays import cells, save_mat
from helio_jax.micrograph import MicrographStack

_SOURCES = {"uniform": "Uniform", "gaussian": "Gaussian", "pencil": "Infinite"}


def write_reference(stack: MicrographStack, path: Path) -> list[str]:
    """Write a stack for which `why_not` returns nothing; return the data that the layout does not hold."""
    save_mat(path, reference_tree(stack))
    return _left_out(stack)


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


def reference_tree(stack: MicrographStack) -> dict[str, dict[str, Any]]:
    """Convert a stack to the variables of the reference simulator's file.

    Args:
        stack: simulated on a raster, with scattering orders whose sum is the counts: `why_not` returns nothing.
    """
    instrument, beam = stack.instrument, stack.instrument.beam
    t = math.radians(beam.incidence_deg)
    orders = {"single": stack.by_order[0], "multiple": stack.multiple}  # type: ignore[index]
    im: dict[str, Any] = {name: cells(_compact(image[:, :, ::-1])) for name, image in orders.items()}  # type: ignore[index]
    im["raster_movement_x"] = pitch(stack.x) * math.cos(t) / 1000
    im["raster_movement_y"] = pitch(stack.y) / 1000
    im["helio_center_um"] = np.array([0.5 * (a[0] + a[-1]) for a in (stack.x, stack.y)])
    apertures = instrument.apertures()
    param = {
        "detector_position": cells([np.array([a.center[0], 0.0 - a.center[1]]) / 1000 for a in apertures]),
        "detector_axes": cells([2 * np.array(a.semi_axes) / 1000 for a in apertures]),
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


def why_not(stack: MicrographStack) -> str:
    """Explain why the reference simulator's layout cannot hold a stack, or return an empty text."""
    n, ny, nx = stack.shape
    if stack.by_order is None or len(stack.by_order) < 2 or stack.n_rays is None:
        return "it holds single and multiple scattering separately, which these micrographs do not"
    if stack.noise != "expected" and not np.array_equal(stack.by_order.sum(0), stack.counts):
        return (
            "it holds single and multiple scattering separately, and here both are expectations while the counts have "
            "noise: for that layout export without noise, or trace with --estimator analog"
        )
    if stack.instrument.beam.azimuth_deg != 0.0:
        return f"in it the beam travels along x, here beam.azimuth_deg is {stack.instrument.beam.azimuth_deg:g}"
    if stack.positions is not None:
        return f"it holds rasters, these micrographs are a list of {nx} positions"
    if n < 2 or min(ny, nx) < 2:
        return f"it holds at least 2 x 2 pixels and 2 detectors, got {nx} x {ny} and {n}"
    try:
        stack.instrument.apertures()
    except SceneError as e:
        return str(e)
    return ""


def _compact(images: np.ndarray) -> list[np.ndarray]:
    """Split images [detector, y, x]; integer counts are converted to the smallest unsigned type."""
    if np.array_equal(images, np.round(images)) and images.min() >= 0 and images.max() < 2**32:
        kind = next(k for k in (np.uint8, np.uint16, np.uint32) if images.max() <= np.iinfo(k).max)
        return list(images.astype(kind))
    return list(images)
