"""Layers: named arrays on one raster, which every writer of a foreign format takes. Made of stacks and height maps.

Missing values (`invalid`): "nan": heights that are not valid and counts that were not observed are NaN; "keep": values
stay as they are; "fill": missing values are interpolated linearly, beyond the known ones the nearest is taken. The
layer of the mask is the same in each case. Units and meanings are those of the HDF5 files (nexus.py).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any, Literal

import numpy as np

from helio_jax.arrays import fill_gaps, pitch
from helio_jax.errors import SceneError
from helio_jax.formats.export_formats import Kind
from helio_jax.formats.nexus import RECONSTRUCTION_FIELDS, STACK_FIELDS
from helio_jax.heightmap import HeightMap
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction

INVALID = ("nan", "keep", "fill")
"""What may be done with missing values."""
_ABOUT = {f.name: f for f in (*STACK_FIELDS, *RECONSTRUCTION_FIELDS)}
_MEANINGS = {
    "std_error": "standard error of the counts",
    "is_valid": "1 where the height is valid",
}
_MAX_BESIDE = 1e-3
"""Largest distance between surface points and pixels, in pitches, that is not worth a remark."""


@dataclass(frozen=True)
class Image:
    """One image of a layer.

    Attributes:
        name: of the layer and its indices, e.g. counts_front.
        values: [y, x]; NaN where missing.
        is_known: False where the value is missing or not valid [y, x].
        unit: "um", "counts", ... or "" for a pure number.
        meaning: one phrase.
    """

    name: str
    values: np.ndarray
    is_known: np.ndarray
    unit: str
    meaning: str


@dataclass(frozen=True)
class Layer:
    """One named array; `axes` names its axes, of which the last two are y and x."""

    name: str
    values: np.ndarray
    axes: tuple[str, ...]
    unit: str
    meaning: str


@dataclass(frozen=True)
class Layers:
    """Arrays on one raster, as they will be written.

    Attributes:
        kind: "heights" or "micrographs".
        title: name of the data.
        x, y: positions of columns and rows [um].
        point_x, point_y: position of each pixel's surface point, or of the beam [y, x], um.
        layers: arrays; the first `n_core` ones are heights or counts, then their error and their mask, if known.
        is_known: where the first layer is valid, of its shape.
        n_core: see `layers`.
        time: when the data were made; now, where not known.
        detectors: names of the detectors.
        is_list: the positions are a list, no raster.
        about: what else is known, as text.
        elsewhere: data of the object that no layer holds.
    """

    kind: Kind
    title: str
    x: np.ndarray
    y: np.ndarray
    point_x: np.ndarray
    point_y: np.ndarray
    layers: tuple[Layer, ...]
    is_known: np.ndarray
    n_core: int
    time: datetime
    detectors: tuple[str, ...] = ()
    is_list: bool = False
    about: Mapping[str, str] = field(default_factory=dict)
    elsewhere: tuple[str, ...] = ()

    @property
    def comment(self) -> str:
        """What is known of the data, as one line of ASCII text."""
        text = "; ".join([self.title, *(f"{key}: {value}" for key, value in self.about.items() if value)])
        return " ".join(text.encode("ascii", "replace").decode().split())

    @property
    def main(self) -> Layer:
        """Heights or counts."""
        return self.layers[0]

    @property
    def distance_beside(self) -> float:
        """Largest distance of a known surface point from its pixel [um]; 0 where not worth a remark."""
        far = np.hypot(self.point_x - self.x, self.point_y - self.y[:, None])
        far = far[np.isfinite(far) & self.is_known.reshape(-1, *far.shape).any(0)].max(initial=0.0)
        return float(far) if far > _MAX_BESIDE * min(pitch(self.x), pitch(self.y)) else 0.0

    @property
    def points(self) -> dict[str, np.ndarray]:
        """Positions of the points [y, x], um, where they are not those of the pixels."""
        if self.is_list or self.distance_beside:
            return {"point_x": self.point_x, "point_y": self.point_y}
        return {}

    def images(self, layers: Sequence[Layer] | None = None) -> list[Image]:
        """Split layers into images; default: heights or counts, their error and their mask."""
        out = []
        for layer in self.layers[: self.n_core] if layers is None else layers:
            has_mask = layer is self.main
            for index in np.ndindex(layer.values.shape[:-2]):
                values = layer.values[index].astype(np.float64)
                is_known = np.isfinite(values) & (self.is_known[index] if has_mask else True)
                parts = [layer.name, *(self._label(axis, i) for axis, i in zip(layer.axes, index, strict=False))]
                out.append(Image("_".join(parts), values, is_known, layer.unit, layer.meaning))
        return out

    def _label(self, axis: str, index: int) -> str:
        """Name one index of an axis."""
        if axis == "detector":
            return self.detectors[index]
        return "xyz"[index] if axis == "component" else str(index + 1)

    def only(self, detector: str) -> "Layers":
        """Return the layers of one detector."""
        k = self.detectors.index(detector)

        def one(values: np.ndarray, axes: tuple[str, ...]) -> np.ndarray:
            return np.take(values, [k], axis=axes.index("detector")) if "detector" in axes else values

        layers = tuple(replace(layer, values=one(layer.values, layer.axes)) for layer in self.layers)
        return replace(self, layers=layers, is_known=one(self.is_known, self.main.axes), detectors=(detector,))


def _with_gaps(values: np.ndarray, is_known: np.ndarray, invalid: str, what: str) -> np.ndarray:
    """Treat missing values [..., y, x] as `invalid` states."""
    if invalid == "keep":
        return values
    out = np.where(is_known, values, np.nan)
    if invalid == "fill":
        for index in np.ndindex(values.shape[:-2]):
            if not is_known[index].any():
                raise SceneError(f"{what}: no pixel is valid, so that nothing can be filled: use --invalid keep or nan")
            if not is_known[index].all():
                out[index] = fill_gaps(values[index], is_known[index])
    return out


def _errors(values: np.ndarray, is_known: np.ndarray, invalid: str) -> np.ndarray:
    """Treat the errors of missing values: what is filled has none."""
    return values if invalid == "keep" else np.where(is_known, values, np.nan)


def _layer(name: str, values: Any, axes: tuple[str, ...], unit: str | None = None) -> Layer:
    """Make a layer with the unit and meaning of the HDF5 files."""
    known = _ABOUT.get(name)
    meaning = _MEANINGS.get(name) or (known.long_name if known else name)
    return Layer(name, np.asarray(values), axes, (known.unit if known else "") if unit is None else unit, meaning)


def _time_of(provenance: Mapping[str, Any]) -> datetime:
    """Return when the data were simulated; now, if that is not known."""
    stack = provenance.get("stack", provenance)
    try:
        return datetime.strptime(stack["time"], "%Y-%m-%dT%H:%M:%SZ").replace(tzinfo=UTC)
    except (KeyError, TypeError, ValueError):
        return datetime.now(UTC)


def layers_of(obj: MicrographStack | Reconstruction | HeightMap, invalid: Literal["nan", "keep", "fill"]) -> Layers:
    """Convert an object to layers.

    Args:
        obj: one stack, a reconstruction or a height map.
        invalid: treatment of missing values, see above.

    Raises:
        SceneError: another treatment, or nothing to fill from.
    """
    if invalid not in INVALID:
        raise SceneError(f"--invalid must be one of {', '.join(INVALID)}, got {invalid!r}")
    if isinstance(obj, MicrographStack):
        return _layers_of_stack(obj, invalid)
    return _layers_of_heights(obj, invalid)


def _layers_of_stack(stack: MicrographStack, invalid: str) -> Layers:
    """Convert a stack; its background is repeated for each pixel."""
    axes = ("detector", "y", "x")
    unit, is_known = stack.unit, stack.is_observed
    core = [_layer("counts", _with_gaps(stack.counts, is_known, invalid, stack.name), axes, unit)]
    if stack.std_error is not None:
        core.append(_layer("std_error", _errors(stack.std_error, is_known, invalid), axes, unit))
    core.append(_layer("is_observed", is_known, axes))
    more = []
    if stack.background is not None:
        background = stack.background.reshape(len(stack.background), *stack.background.shape[1:] or (1, 1))
        more.append(_layer("background", np.broadcast_to(background, stack.shape).copy(), axes, unit))
    if stack.by_order is not None:
        more.append(_layer("by_order", stack.by_order, ("order", *axes), unit))
    if stack.by_order_variance is not None:
        more.append(_layer("by_order_std_error", np.sqrt(stack.by_order_variance), ("order", *axes), unit))
    if stack.effuse_variance is not None:
        more.append(_layer("effuse_std_error", np.sqrt(stack.effuse_variance), axes, unit))
    for name, own in (("effuse", unit), ("plate", unit), ("masked", "")):
        if getattr(stack, name) is not None:
            more.append(_layer(name, getattr(stack, name), axes, own))
    if stack.shadowed is not None:
        more.append(_layer("shadowed", stack.shadowed, ("y", "x")))
    if stack.dwell_map is not None:
        more.append(_layer("dwell_map", stack.dwell_map, ("y", "x"), "s"))
    if stack.positions is None:
        point_x, point_y = np.meshgrid(stack.x, stack.y)
    else:
        point_x, point_y = stack.positions.T[:, None, :]
    return Layers(
        kind="micrographs",
        title=stack.name,
        x=stack.x,
        y=stack.y,
        point_x=point_x,
        point_y=point_y,
        layers=(*core, *more),
        is_known=is_known,
        n_core=len(core),
        detectors=tuple(stack.instrument.detector_names),
        is_list=stack.positions is not None,
        about={"noise": stack.noise, "fast_axis": stack.fast_axis, "invalid": invalid},
        elsewhere=("instrument", "history"),
        time=_time_of(stack.provenance),
    )


def _layers_of_heights(obj: Reconstruction | HeightMap, invalid: str) -> Layers:
    """Convert a reconstruction or a height map."""
    axes = ("y", "x")
    is_known = np.isfinite(obj.height) & (True if isinstance(obj, HeightMap) else obj.is_valid)
    core = [_layer("height", _with_gaps(obj.height, is_known, invalid, "heights"), axes)]
    if obj.height_std is not None:
        core.append(_layer("height_std", _errors(obj.height_std, is_known, invalid), axes))
    core.append(_layer("is_valid", is_known, axes))
    about = {"status": obj.status, "invalid": invalid}
    more, detectors, elsewhere = [], (), ()
    if isinstance(obj, HeightMap):
        x, y, (shift_x, shift_y) = obj.x, obj.y, (0.0, 0.0)
    else:
        x, y, (shift_x, shift_y) = obj.raster_x, obj.raster_y, obj.instrument.beam_shift
        more = [
            _layer("reason", obj.reason, axes),
            _layer("albedo", obj.albedo, axes),
            _layer("normals", np.moveaxis(obj.normals, -1, 0), ("component", *axes)),
        ]
        optional = (("chi_square", axes), ("residuals", ("detector", *axes)))
        more += [_layer(name, getattr(obj, name), a) for name, a in optional if getattr(obj, name) is not None]
        about |= {"method": obj.method, "border": obj.border}
        detectors = tuple(obj.instrument.detector_names)
        elsewhere = (*(() if obj.height_samples is None else ("height_samples",)), "instrument", "history")
    height = core[0].values  # as written: a point moves with its height
    return Layers(
        kind="heights",
        title="height",
        x=x,
        y=y,
        point_x=x - height * shift_x,
        point_y=y[:, None] - height * shift_y,
        layers=(*core, *more),
        is_known=is_known,
        n_core=len(core),
        detectors=detectors,
        about=about,
        elsewhere=elsewhere,
        time=_time_of(obj.provenance),
    )
