"""A plate from a mesh file: a solid with channels, and its detecting parts.

Plate frame: x, y of the lab, z = 0 in the plane of the pinhole, z up, um; the whole mesh lies at z >= 0. The tracer
moves it with the beam (trace/meshplate.py).
"""

from pathlib import Path

import numpy as np

from helio_jax.detector import Detector
from helio_jax.errors import InputFileError
from helio_jax.instrument import Plate
from helio_jax.scene.body import Body
from helio_jax.scene.meshes import load_mesh
from helio_jax.scene.placement import rotation_matrix
from helio_jax.scene.sample import MESH_EXTENT_UM, check_body
from helio_jax.settings import UNITS_UM

MAX_PLATE_MB = 200.0
"""Largest mesh file of a plate."""
SOLID = "the plate"
"""Material of the plate's faces that do not detect atoms."""


def read_plate(plate: Plate, detectors: tuple[Detector, ...], base_dir: Path = Path()) -> Body:
    """Read the mesh of a plate, plate frame; its materials are `SOLID` and the names of the detecting parts.

    Raises:
        InputFileError: the file is missing, too large, unreadable, or lacks a part; the plate has an implausible size,
            reaches below the plane of the pinhole, is inside out, or has detecting parts only.
    """
    assert plate.file is not None and plate.unit is not None  # by the plate's validator
    path = base_dir / plate.file
    parts = tuple(dict.fromkeys(d.part for d in detectors if d.part is not None))
    own = () if plate.part is None else (plate.part,)
    vertices, faces, index = load_mesh(path, MAX_PLATE_MB, (*parts, *own))
    if own:
        faces, index = faces[index > 0], index[index > 0] % (len(parts) + 1)
    body = Body(vertices, faces, materials=(SOLID, *parts), face_material=index)
    body = body.transformed(
        rotation_matrix(plate.rotate_deg or (0.0, 0.0, 0.0)),
        UNITS_UM[plate.unit],
        plate.translate_um or (0.0, 0.0, 0.0),
    )
    (low, high), (least, most) = body.bounds, MESH_EXTENT_UM
    extent = float((high - low).max())
    if not least <= extent <= most:
        raise InputFileError(
            f"{path}: the plate is {extent:g} um across, plausible are {least:g} to {most:g} um: check plate.unit (now "
            f"{plate.unit!r})"
        )
    if low[2] < -1e-6 * extent:
        raise InputFileError(
            f"{path}: the plate reaches down to z = {low[2]:g} um, it must lie at z >= 0, the plane of the pinhole "
            "from which all distances count: move it with plate.translate_um"
        )
    if not np.any(index == 0):
        raise InputFileError(f"{path}: all parts of the mesh are detectors: there is no plate between them")
    if check_solid(body)["is_inside_out"]:
        raise InputFileError(
            f"{path}: the plate is inside out (volume < 0): flip its normals in the program that made it"
        )
    return body


def check_solid(body: Body) -> dict:
    """Report on the faces of a plate that do not detect atoms, as `check_body`."""
    return check_body(body.with_faces(body.face_material == 0))
