"""NeXus layout of micrographs and reconstructions: path, unit and long name of every array.

Converts between these objects and a flat list of nodes; `hdf5` writes and reads the nodes. Arrays are stored in float64
(masks in uint8), so that a file is read back bit for bit; None is omitted. Derived values (`counts_errors`, `/entry/x`,
`/entry/y`) are written for other programs and not read back.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from pydantic import ValidationError

from helio_jax.errors import HelioError, InputFileError
from helio_jax.instrument import Instrument
from helio_jax.micrograph import Calibration, MicrographSet, MicrographStack, ScanAlignment
from helio_jax.reconstruction import Reconstruction
from helio_jax.settings import in_one_line
from helio_jax.texts import parse_json
from helio_jax.validity import REASONS, VALID_RULE

Noun = MicrographStack | MicrographSet | Reconstruction


@dataclass(frozen=True)
class Node:
    """A group (`value` None), a dataset, or an alias of a dataset (`same_as`); attributes are texts."""

    path: str
    value: Any = None
    attributes: Mapping[str, str | list[str]] = field(default_factory=dict)
    same_as: str | None = None


@dataclass(frozen=True)
class Field:
    """One attribute of an object: its path below the entry, unit ("counts": that of the stack) and long name."""

    name: str
    place: str
    unit: str
    long_name: str


STACK_FIELDS = (
    Field("counts", "micrographs/counts", "counts", "counts per pixel"),
    Field("x", "micrographs/x", "um", "beam position x on the sample plane"),
    Field("y", "micrographs/y", "um", "beam position y on the sample plane"),
    Field("positions", "positions", "um", "beam position (x, y) of every column, where the scan is no raster"),
    Field("variance", "micrographs/variance", "counts^2", "variance of the counts"),
    Field("is_observed", "is_observed", "", "1 where a count was recorded"),
    Field("background", "background", "counts", "counts per pixel that do not come from the sample"),
    Field("by_order", "by_order/counts", "counts", "counts by scattering order, the last one and above"),
    Field("by_order_variance", "by_order/variance", "counts^2", "variance of the counts by scattering order"),
    Field("effuse", "effuse", "counts", "counts from the effusive beam"),
    Field("effuse_variance", "effuse_variance", "counts^2", "variance of the counts from the effusive beam"),
    Field("plate", "plate", "counts", "counts from plate bounces"),
    Field("masked", "masked", "", "fraction of the aperture masked by the sample"),
    Field("shadowed", "shadowed", "", "1 where the topmost surface is shadowed"),
    Field("parallax", "parallax", "counts/um", "change of the counts per um of height, where several beams are joined"),
    Field("parallax_height", "parallax_height", "um", "heights at which the images of several beams were read"),
    Field("n_rays", "n_rays", "", "simulated beam atoms per pixel"),
    Field("dwell", "dwell_time", "s", "dwell time per pixel"),
    Field("dwell_map", "dwell_map", "s", "dwell time of every pixel; counts are scaled to dwell_time"),
    Field("sample_rotation", "sample_rotation", "rad", "rotation of the sample about the plate normal"),
    Field("stage_position", "stage_position", "um", "stage position (x, y, height) where the beam position is 0, 0"),
    Field("fast_axis", "fast_axis", "", "axis along which the scan moves fastest"),
    Field("noise", "noise", "", "expected, poisson or measured counts"),
    Field("unit", "unit", "", "unit of the counts"),
    Field("name", "title", "", "short name of the scan"),
)
RECONSTRUCTION_FIELDS = (
    Field("height", "height/height", "um", "height above the substrate"),
    Field("height_std", "height/height_errors", "um", "standard deviation of the height"),
    Field("height_samples", "height_samples", "um", "joint posterior deviations of the heights"),
    Field("raster_x", "height/raster_x", "um", "beam position x on the sample plane"),
    Field("raster_y", "height/raster_y", "um", "beam position y on the sample plane"),
    Field("normals", "normals", "", "unit surface normal (x, y, z), up"),
    Field("albedo", "albedo", "", "relative reflectivity, substrate = 1"),
    Field("is_valid", "is_valid", "", f"1 where valid: {VALID_RULE}"),
    Field("reason", "reason", "", "why a height is not valid: " + ", ".join(f"{i} {r}" for i, r in enumerate(REASONS))),
    Field("residuals", "residuals", "", "(data - model) / standard deviation"),
    Field("chi_square", "chi_square", "", "mean square deviation of the data from the traced map, 3 x 3 pixels"),
    Field("gain", "gain", "", "data = gain * model + offset, per detector"),
    Field("offset", "offset", "", "data = gain * model + offset, per detector"),
    Field("border", "border", "", "flat: heights count from the substrate at the border; free: their level is unknown"),
    Field("method", "method", "", "how the heights were found"),
    Field("status", "status", "", "how the method ended"),
    Field("warnings", "warnings", "", "what to know before the heights are trusted, one a line"),
)
RECORDS = {"calibration": Calibration, "alignment": ScanAlignment, "materials": dict}
"""Attributes of a stack that are one JSON text each, at a place of their name."""
COMMON_PLACES = ("instrument/settings", *RECORDS, "provenance/data")
READ_PLACES = (*COMMON_PLACES, *(f.place for f in (*STACK_FIELDS, *RECONSTRUCTION_FIELDS)))
"""Paths below an entry that the reader needs; everything else in a file is ignored."""

KINDS: dict[type, str] = {
    MicrographStack: "micrographs",
    MicrographSet: "micrograph_set",
    Reconstruction: "reconstruction",
}


def lay_out(obj: Noun) -> list[Node]:
    """Lay out the nodes of a file that holds `obj`, groups before their members, root excluded.

    Raises:
        HelioError: the provenance is not JSON-compatible, or `obj` is of another type.
    """
    if isinstance(obj, MicrographStack):
        return _stack_nodes("/entry", "NXentry", obj)
    if isinstance(obj, Reconstruction):
        return _reconstruction_nodes("/entry", obj)
    if isinstance(obj, MicrographSet):
        nodes = [Node("/entry", None, {"NX_class": "NXentry", "default": "scan_1"})]
        nodes += _provenance_nodes("/entry", obj.provenance)
        for i, stack in enumerate(obj.stacks, start=1):
            nodes += _stack_nodes(f"/entry/scan_{i}", "NXsubentry", stack)
        return nodes
    raise HelioError(f"only micrographs and reconstructions can be written, got a {type(obj).__name__}")


def _stack_nodes(entry: str, nx_class: str, stack: MicrographStack) -> list[Node]:
    """Lay out one stack below `entry`."""
    plot = {"NX_class": "NXdata", "signal": "counts"}
    axes = ["detector", "y", "x"]
    nodes = [
        Node(entry, None, {"NX_class": nx_class, "default": "micrographs"}),
        Node(f"{entry}/micrographs", None, {**plot, "axes": axes, "title": stack.name}),
    ]
    if stack.by_order is not None:
        orders = np.arange(1.0, len(stack.by_order) + 1)
        label = {"units": "", "long_name": "scattering order, the last one and above"}
        nodes.append(Node(f"{entry}/by_order", None, {**plot, "axes": ["order", *axes]}))
        nodes.append(Node(f"{entry}/by_order/order", orders, label))
    nodes += _field_nodes(entry, stack, STACK_FIELDS, stack.unit)
    number = {"units": "", "long_name": "detector: " + ", ".join(stack.instrument.detector_names)}
    nodes.append(Node(f"{entry}/micrographs/detector", np.arange(1.0, len(stack.counts) + 1), number))
    if stack.std_error is not None:
        label = {"units": stack.unit, "long_name": "standard deviation of the counts"}
        nodes.append(Node(f"{entry}/micrographs/counts_errors", stack.std_error, label))
    if stack.by_order is not None:
        nodes += [Node(f"{entry}/by_order/{a}", same_as=f"{entry}/micrographs/{a}") for a in axes]
    for name, record in RECORDS.items():
        if value := getattr(stack, name):
            text = json.dumps(value if record is dict else asdict(value))
            nodes.append(_text_node(f"{entry}/{name}", text, f"{name}: what later steps depend on (JSON)"))
    return nodes + _instrument_nodes(entry, stack.instrument) + _provenance_nodes(entry, stack.provenance)


def _reconstruction_nodes(entry: str, rec: Reconstruction) -> list[Node]:
    """Lay out a reconstruction below `entry`."""
    plot = {"NX_class": "NXdata", "signal": "height", "axes": ["raster_y", "raster_x"], "title": "height"}
    nodes = [
        Node(entry, None, {"NX_class": "NXentry", "default": "height"}),
        Node(f"{entry}/height", None, plot),
    ]
    nodes += _field_nodes(entry, rec, RECONSTRUCTION_FIELDS, "")
    for name in ("x", "y"):
        label = {"units": "um", "long_name": f"surface point {name} in the sample frame"}
        nodes.append(Node(f"{entry}/{name}", getattr(rec, name), label))
    return nodes + _instrument_nodes(entry, rec.instrument) + _provenance_nodes(entry, rec.provenance)


def _field_nodes(entry: str, obj: Any, fields: tuple[Field, ...], count_unit: str) -> list[Node]:
    """Lay out the attributes of an object that are not None."""
    nodes = []
    for f in fields:
        value = getattr(obj, f.name)
        if value is None:
            continue
        if isinstance(value, np.ndarray) and value.dtype == bool:
            value = value.astype(np.uint8)
        if isinstance(value, tuple):
            value = "\n".join(value)
        unit, meaning = f.unit.replace("counts", count_unit) if count_unit else f.unit, f.long_name
        if f.name in ("x", "y") and getattr(obj, "positions", None) is not None:
            unit, meaning = "", "number of the beam position" if f.name == "x" else "0: a list has one row"
        nodes.append(Node(f"{entry}/{f.place}", value, {"units": unit, "long_name": meaning}))
    return nodes


def _instrument_nodes(entry: str, instrument: Instrument) -> list[Node]:
    """Lay out the instrument as JSON text."""
    text = instrument.model_dump_json(exclude_none=True)
    group = Node(f"{entry}/instrument", None, {"NX_class": "NXinstrument"})
    return [group, _text_node(f"{entry}/instrument/settings", text, "beam, plate and detectors (JSON)")]


def _provenance_nodes(entry: str, provenance: Mapping[str, Any]) -> list[Node]:
    """Lay out the provenance as a JSON note."""
    try:
        text = json.dumps(_plain(provenance), ensure_ascii=True)
    except (TypeError, ValueError) as e:
        raise HelioError(f"provenance must be JSON-compatible: {e}") from None
    group = Node(f"{entry}/provenance", None, {"NX_class": "NXnote", "type": "application/json"})
    return [group, _text_node(f"{entry}/provenance/data", text, "where the data came from (JSON)")]


def _text_node(path: str, text: str, long_name: str) -> Node:
    """Return a text dataset."""
    return Node(path, text, {"units": "", "long_name": long_name})


def _plain(value: Any) -> Any:
    """Convert mappings, numpy numbers and arrays to JSON types; `json` refuses other types."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else value


def rebuild(kind: str, entries: dict[str, dict[str, Any]], path: str, version: str) -> Noun:
    """Construct the object from the values of a file.

    Args:
        kind: the file's `filetype`.
        entries: values by path below the entry, for the entry itself ("") and its scans ("scan_1", ...).
        path: the file, for messages.
        version: the file's `helio_format`.

    Raises:
        InputFileError: the kind is unknown, data are missing, or the object's own checks fail.
    """
    top = entries.get("", {})
    if kind == "micrographs":
        return _make(MicrographStack, STACK_FIELDS, top, f"{path}: /entry", version)
    if kind == "reconstruction":
        return _make(Reconstruction, RECONSTRUCTION_FIELDS, top, f"{path}: /entry", version)
    if kind == "micrograph_set":
        names = sorted((n for n in entries if n), key=lambda n: int(n.removeprefix("scan_")))
        stacks = tuple(_make(MicrographStack, STACK_FIELDS, entries[n], f"{path}: /entry/{n}", version) for n in names)
        if not stacks:
            raise InputFileError(f"{path}: /entry holds no scan_1, scan_2, ...: the file is incomplete")
        return MicrographSet(stacks, _json_object(top, "provenance/data", f"{path}: /entry"))
    raise InputFileError(f"{path}: filetype must be one of {', '.join(KINDS.values())}, got {kind!r}")


def _make(noun: type, fields: tuple[Field, ...], values: dict[str, Any], place: str, version: str) -> Any:
    """Construct one stack or reconstruction from its values."""
    given = {f.name: values[f.place] for f in fields if f.place in values}
    try:
        for name, value in given.items():
            # stored as arrays without axes
            given[name] = float(value) if isinstance(value, np.ndarray) and value.ndim == 0 else value
        provenance = _json_object(values, "provenance/data", place)
        given |= _records_in_provenance(noun, provenance) if version == "1.0" else _records(values, place)
        _check_record(noun, given)
        if "warnings" in given:
            given["warnings"] = tuple(filter(None, given["warnings"].split("\n")))
        return noun(**given, instrument=_instrument(values, place), provenance=provenance)
    except InputFileError as e:
        raise InputFileError(str(e) if str(e).startswith(place) else f"{place}: {e}") from None
    except (TypeError, ValueError) as e:
        raise InputFileError(f"{place} is incomplete or of the wrong kind: {e}") from None


def _check_record(noun: type, given: dict[str, Any]) -> None:
    """Check the texts and numbers that the object does not check itself."""
    choices = {"fast_axis": ("x", "y"), "noise": ("expected", "poisson", "measured"), "border": ("flat", "free")}
    for name in ("fast_axis", "noise", "unit", "name", "border", "method", "status", "warnings"):
        if name in given and not isinstance(given[name], str):
            raise InputFileError(f"{name} must be a text, got numbers")
        if name in given and name in choices and given[name] not in choices[name]:
            raise InputFileError(f"{name} must be one of {', '.join(choices[name])}, got {given[name]!r}")
    for name in ("n_rays", "dwell", "sample_rotation"):
        if name in given and not (isinstance(given[name], float) and math.isfinite(given[name])):
            raise InputFileError(f"{name} must be one finite number, got {given[name]!r}")
    for name in ("is_observed", "is_valid", "reason"):
        if name in given and getattr(given[name], "dtype", None) != np.uint8:
            raise InputFileError(f"{name} must hold 8-bit whole numbers")
    required = ("counts", "x", "y") if noun is MicrographStack else ("height", "raster_x", "raster_y", "normals")
    missing = [name for name in required if name not in given]
    if missing:
        raise InputFileError(f"{', '.join(missing)} missing: the file is incomplete")


def _instrument(values: dict[str, Any], place: str) -> Instrument:
    """Parse the instrument."""
    text = values.get("instrument/settings")
    if not isinstance(text, str):
        raise InputFileError(f"{place}/instrument/settings is missing: the file is incomplete")
    try:
        return Instrument.model_validate_json(text)
    except ValidationError as e:
        why = in_one_line(e, Instrument)
        raise InputFileError(f"{place}/instrument/settings is not a valid instrument: {why}") from None


def _records(values: dict[str, Any], place: str) -> dict[str, Any]:
    """Read the records of a stack back from their JSON texts."""
    return {name: record(**_json_object(values, name, place)) for name, record in RECORDS.items() if name in values}


def _records_in_provenance(noun: type, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Find the records and settings that a file of format 1.0 keeps in its provenance."""

    def table(key: str) -> Mapping[str, Any]:
        found = provenance.get(key, {})
        if not isinstance(found, Mapping):
            raise InputFileError(f"provenance/data: {key} must be a JSON object, got {type(found).__name__}")
        return found

    if noun is Reconstruction:
        return {"border": table("reconstruct").get("border", "flat")}
    found: dict[str, Any] = {"materials": table("materials")}
    if record := table("calibrate"):
        found["calibration"] = Calibration("border", record.get("priors", {}))
    elif record := table("self_calibrate"):
        is_subtracted = record.get("without_multiple", False)
        found["calibration"] = Calibration("constant_albedo", record.get("priors", {}), is_subtracted)
    if "align" in provenance or "scan_time" in provenance:
        found["alignment"] = ScanAlignment(provenance.get("scan_time"))
    return found


def _json_object(values: dict[str, Any], name: str, place: str) -> dict[str, Any]:
    """Read a JSON object; an empty one where it is missing."""
    try:
        found = parse_json(values.get(name, "{}"))
    except (TypeError, ValueError) as e:
        raise InputFileError(f"{place}/{name} is not JSON: {e}") from None
    if not isinstance(found, dict):
        raise InputFileError(f"{place}/{name} must be a JSON object, got {type(found).__name__}")
    return found
