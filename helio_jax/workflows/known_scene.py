"""The scene of a scan of a known object, for the tracer: multiple scattering, and simulations of calibrations."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from helio_jax.calibration.known_objects import KnownObject
from helio_jax.calibration.unknowns import RAYS
from helio_jax.forward.optics import Raster
from helio_jax.instrument import Instrument
from helio_jax.workflows.pipeline import simulate
from helio_jax.workflows.scene_file import SceneFile

_GROUND, _OBJECT = "substrate", "object"


def known_scene(
    known: KnownObject,
    numbers: Mapping[str, float],
    instrument: Instrument,
    x: np.ndarray,
    y: np.ndarray,
    *,
    substrate_um: float,
) -> SceneFile:
    """Make the scene of a known object on a tilted substrate.

    Args:
        known: what kind of object.
        numbers: place, tilt, shape, albedo and law by the names of `unknowns.OBJECT` [um, rad].
        instrument: of the scan.
        x, y: its beam positions, um.
        substrate_um: side of the substrate.
    """
    o, deg = numbers, math.degrees(1.0)
    about_y = -o["tilt x"]
    about_x = math.atan(math.tan(o["tilt y"]) * math.cos(about_y))
    ratio = math.exp(o["log albedo ratio"])
    sample: dict[str, Any] = {"size_um": substrate_um, "rotate_deg": [deg * about_x, deg * about_y, 0.0]}
    if known.kind == "ball":
        ball = {"radius_um": o["radius"], "cap_height_um": o["height"], "center_um": [o["object x"], o["object y"]]}
        sample |= {"kind": "spheres", "material": _GROUND, "spheres": [ball | {"material": _OBJECT}]}
    else:
        edge = {"position_um": o["object x"], "facing_deg": deg * math.remainder(o["object azimuth"], 2.0 * math.pi)}
        sample |= {"kind": "step", "height_um": o["height"], "slope_deg": deg * o["slope"], **edge}
    law = {"kind": "power", "exponent": o["exponent"]} if o["exponent"] else {"kind": "cosine"}
    tables = instrument.idealised().model_dump(mode="json", exclude_none=True, exclude={"uncertainty"})
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)  # a list, for the pitches of x and y may differ
    tables |= {"name": "known object", "sample": sample, "scan": {"kind": "list", "points_um": points.tolist()}}
    if known.kind != "ball":
        sample["material"], tables["material"] = _GROUND, {_GROUND: law}
    else:
        # nothing reflects more than it receives: of the two, the brighter one has the albedo 1
        tables["material"] = {
            _GROUND: law | {"albedo": min(1.0, 1.0 / ratio)},
            _OBJECT: law | {"albedo": min(1.0, ratio)},
        }
    return SceneFile.model_validate(tables)


def multiple_tracer(
    known: list[KnownObject], *, rays: int, substrate_um: float
) -> Callable[[int, Instrument, dict[str, float], Raster, int], np.ndarray]:
    """Return what traces the multiple scattering of a scan of a known object, see `calibration.known_shape.Trace`.

    The albedo of the own pixel is not divided out.
    """

    def trace(
        number: int, instrument: Instrument, numbers: dict[str, float], raster: Raster, thrift: int
    ) -> np.ndarray:
        scene = known_scene(known[number], numbers, instrument, raster.x, raster.y, substrate_um=substrate_um)
        fewer = max(min(rays, RAYS[0]), rays // thrift)  # the noise of still fewer is misfit to be explained
        found = simulate(scene, rays=fewer, seed=number + 1, maps=False).only()
        assert found.by_order is not None and found.n_rays is not None  # simulated
        return (found.by_order[1:].sum(0) / found.n_rays).reshape(-1, *raster.shape)

    return trace
