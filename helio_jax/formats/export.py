"""Write micrographs and heights for other programs; the suffix selects the format from the table in export_formats."""

import importlib
import os
from pathlib import Path
from typing import Any, Literal

from helio_jax.errors import SceneError
from helio_jax.formats.export_formats import FORMATS, SUFFIXES, Format, find_format, suffixes_for
from helio_jax.formats.layers import Layers, layers_of
from helio_jax.formats.safe import atomic_path
from helio_jax.formats.write_reference import why_not, write_reference
from helio_jax.heightmap import HeightMap
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.reconstruction import Reconstruction


def export(
    obj: MicrographStack | MicrographSet | Reconstruction | HeightMap,
    path: str | os.PathLike,
    *,
    view: int | None = None,
    detector: str | None = None,
    invalid: Literal["nan", "keep", "fill"] = "nan",
) -> list[str]:
    """Write micrographs or heights as they are; see workflows/export.py for the arguments, the result and errors."""
    stack = _one_of(obj, view, path)
    form = find_format(Path(path).suffix)
    if form is None:
        raise SceneError(f"{path}: no format has the suffix {Path(path).suffix!r}: known are {' '.join(SUFFIXES)}")
    if not isinstance(stack, (MicrographStack, Reconstruction, HeightMap)):
        raise SceneError(f"{path}: a {type(obj).__name__} cannot be exported: give micrographs or heights")
    note = []
    if form.name == "MAT" and isinstance(stack, MicrographStack) and detector is None:
        if not (reason := why_not(stack)):
            with atomic_path(path) as part:
                return write_reference(stack, part)
        if stack.noise != "measured":  # that layout is for simulations
            note = [f"the layout of the reference simulator: {reason}; the file holds arrays under names of their own"]
    layers = _chosen(layers_of(stack, invalid), form, detector, path)
    module, _, name = form.writer.partition(":")
    writer = getattr(importlib.import_module(f"helio_jax.formats.{module}"), name)
    with atomic_path(path) as part:
        writer(layers, part)
    return note + _left_out(layers, form)


def _one_of(obj: Any, view: int | None, path: str | os.PathLike) -> Any:
    """Return the object itself, or one stack of a set."""
    n = len(obj.stacks) if isinstance(obj, MicrographSet) else 1
    if (view is None and n > 1) or not 0 <= (view or 0) < n:
        given = "" if view is None else f", got {view}"
        raise SceneError(f"{path}: holds one scan, the set has {n}: give --view 0 to {n - 1}{given}")
    return obj.stacks[view or 0] if isinstance(obj, MicrographSet) else obj


def _chosen(layers: Layers, form: Format, detector: str | None, path: str | os.PathLike) -> Layers:
    """Return the layers of the detector that was asked for, after a check that the format can hold them."""
    if layers.kind not in form.kinds:
        instead = "reconstruct them first, or " if layers.kind == "micrographs" else ""
        raise SceneError(
            f"{path}: {form.name} holds {' and '.join(form.kinds)}, these are {layers.kind}: {instead}choose one of "
            f"{suffixes_for(layers.kind)}"
        )
    if layers.is_list and not form.has_points:
        listed = " ".join(f.suffixes[0] for f in FORMATS if f.has_points and layers.kind in f.kinds)
        raise SceneError(f"{path}: {form.name} holds rasters, this scan is a list of positions: choose one of {listed}")
    if detector is None and form.amount == "image" and len(layers.main.values.shape) > 2 and len(layers.detectors) > 1:
        raise SceneError(
            f"{path}: {form.name} holds one image, the scan has {len(layers.detectors)}: give --detector "
            f"{' or '.join(layers.detectors)}"
        )
    if detector is None:
        return layers
    if layers.kind == "heights":
        raise SceneError(f"{path}: heights belong to no detector: leave --detector {detector} out")
    if detector not in layers.detectors:
        raise SceneError(f"{path}: no detector is called {detector!r}: known are {', '.join(layers.detectors)}")
    return layers.only(detector)


def _left_out(layers: Layers, form: Format) -> list[str]:
    """List what a format does not hold."""
    n_held = {"image": 1, "core": layers.n_core, "all": len(layers.layers)}[form.amount]
    out = []
    if names := [layer.name for layer in layers.layers[n_held:]]:
        fuller = " or ".join(f.suffixes[0] for f in FORMATS if f.amount == "all" and layers.kind in f.kinds)
        out.append(f"{', '.join(names)}: {form.name} has no place for them; {fuller} does")
    if not form.has_origin:
        out.append(f"x = {layers.x[0]:g} um, y = {layers.y[0]:g} um of the first pixel: {form.name} has no field")
    if not form.has_points and (distance := layers.distance_beside):
        out.append(
            f"positions of the surface points, up to {distance:.4g} um beside their pixels (the raster is that of an "
            "oblique beam): --grid PITCH resamples, .csv and meshes hold each point's own position"
        )
    if not form.has_text and (status := layers.about.get("status")):
        out.append(f"status ({status}): {form.name} has no place for text")
    if layers.elsewhere:
        out.append(f"{', '.join(layers.elsewhere)}: they stay in the .h5 file")
    return out
