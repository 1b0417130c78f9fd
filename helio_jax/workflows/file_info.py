"""What a file holds, in about ten lines, for every kind of file that the program reads; and all of it on request."""

import json
import os
import re
import textwrap
import zipfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.child import check_size
from helio_jax.errors import InputFileError
from helio_jax.figures.summary import Rows, summarise
from helio_jax.figures.wording import plural
from helio_jax.formats import hdf5
from helio_jax.formats.matlab import describe_matlab
from helio_jax.formats.parts import Parts
from helio_jax.formats.points import HEADER, read_points, read_rows
from helio_jax.formats.suffixes import HDF5_SUFFIXES
from helio_jax.reconstruction import Reconstruction
from helio_jax.scene.body import Body
from helio_jax.scene.files import MAX_HEIGHT_MAP_MB, check_file, read_bytes, read_height_map, read_table, read_toml
from helio_jax.scene.meshes import KINDS as MESHES
from helio_jax.scene.meshes import load_mesh
from helio_jax.scene.sample import MeshSample, check_body
from helio_jax.texts import parse_json
from helio_jax.workflows.scene_file import (
    SceneFile,
    is_scene,
    is_study,
    load_instrument,
    load_scene,
    read_tables,
    resolved,
)
from helio_jax.workflows.shipped import locate
from helio_jax.workflows.study_file import MAX_STUDY_MB, load_study

MAX_INDEX_MB = 200.0
"""Largest index of a study."""
MAX_UNITS = 1_000_000
"""Largest number of units of a run that are counted."""
TABLES = (".csv", ".tsv", ".txt")
_MANY = 10
"""Most columns whose contents are shown."""
_MANY_WORDS = 5
"""Most frequent words of a column that are shown."""


@dataclass(frozen=True)
class FileInfo:
    """What a file holds.

    Attributes:
        file, kind, n_bytes: path, kind in words, size.
        rows: (label, text) for a person.
        details: everything else, JSON-compatible; of a helio file as `formats.hdf5.describe`.
    """

    file: str
    kind: str
    n_bytes: int
    rows: Rows
    details: dict[str, Any]

    def as_dict(self) -> dict[str, Any]:
        """Return a JSON-compatible record."""
        return {"file": self.file, "kind": self.kind, "bytes": self.n_bytes, **self.details, "summary": dict(self.rows)}

    def detail_lines(self) -> list[str]:
        """List the details for the terminal: one line per array, setting or entry."""
        if "entries" not in self.details:
            return json.dumps(self.details, indent=2, ensure_ascii=False).splitlines()
        lines = []
        for name, entry in self.details["entries"].items():
            lines.append(f"{name or 'entry'}:")
            for place, field in entry["fields"].items():
                shape = " x ".join(map(str, field.get("shape", ()))) or "scalar"
                unit, about = field.get("unit", ""), field.get("long_name", "")
                lines.append(f"  {place:<24} {shape:<18} {unit:<10} {about}".rstrip())
            for key in ("instrument", "calibration", "alignment", "materials", "provenance"):
                lines += [f"  {key}:"] if entry.get(key) else []
                for label, value in (entry.get(key) or {}).items():
                    shown = textwrap.shorten(json.dumps(value), 300, placeholder=" ... (--json: all)")
                    lines.append(f"    {label}: {shown}")
        return lines


def file_info(path: str | os.PathLike) -> FileInfo:
    """Find out what a file holds, or a scene or an instrument that comes with the program, by its name.

    Of a run or study that is not finished: how far it is, by its output or its folder.

    Raises:
        InputFileError: missing, damaged, or of a kind that the program does not read.
        SceneError: a wrong scene, instrument or study file, or an unknown name.
    """
    if unfinished := _unfinished_run(Path(path)) or _study_folder(Path(path)):
        return unfinished
    path = locate(path)
    suffix = path.suffix.lower()
    n_bytes = check_size(path, hdf5.MAX_BYTES)
    readers = {".toml": _of_toml, ".mat": _of_matlab, ".npz": _of_npz, ".npy": _of_npy, ".mtl": _of_mtl}
    readers |= (
        dict.fromkeys(HDF5_SUFFIXES, _of_hdf5) | dict.fromkeys(MESHES, _of_mesh) | dict.fromkeys(TABLES, _of_table)
    )
    if suffix not in readers:
        raise InputFileError(
            f"{path}: unknown kind of file {suffix or 'without a suffix'}: known are {', '.join(readers)}"
        )
    kind, rows, details = readers[suffix](path)
    return FileInfo(str(path), kind, n_bytes, rows, details)


def _unfinished_run(path: Path) -> FileInfo | None:
    """Return how far a simulation is, by its output, the folder of its parts, or the folder of a run."""
    outputs = [path, path.with_name(path.name.removesuffix(".parts"))] if path.name else []
    for output in (*outputs, path / "micrographs.h5"):
        parts = Parts(output)
        if parts.exist and not output.exists():
            about = parts.manifest()
            n_units = about.get("n_units")
            n = min(n_units, MAX_UNITS) if isinstance(n_units, int) else 0
            done = sum(parts.has(i) for i in range(n))
            command = about.get("command")
            scene = command.get("scene", "unknown") if isinstance(command, dict) else "unknown"
            given = output.parent if path.is_dir() and output.name == "micrographs.h5" else output
            rows = [
                ("unfinished", f"{done} of {n} units of work are stored"),
                ("scene", str(scene)),
                ("to go on", f"helio resume {given}"),
            ]
            return FileInfo(str(path), "unfinished run", 0, rows, {"units": n, "done": done})
    return None


def _study_folder(path: Path) -> FileInfo | None:
    """Return how far the study of a folder is; its index is written when the first point has ended."""
    manifest, index = path / "study.json", path / "index.json"
    if not manifest.is_file():
        return None
    try:
        study = str(parse_json(read_bytes(manifest, MAX_STUDY_MB))["study"])
        points = parse_json(read_bytes(index, MAX_INDEX_MB)) if index.is_file() else []
        status = Counter(str(row["status"]) for row in points)
    except (ValueError, TypeError, KeyError) as e:
        raise InputFileError(f"{path}: its study.json or index.json is damaged ({e!r}): helio resume {path}") from None
    rows = [
        ("study", study),
        ("points", ", ".join(f"{n} {name}" for name, n in status.items()) or "none finished"),
    ]
    if set(status) != {"done"}:
        rows.append(("to go on", f"helio resume {path}"))
    return FileInfo(str(path), "folder of a study", 0, rows, dict(status))


Found = tuple[str, Rows, dict[str, Any]]
"""Kind, rows and details of a file."""


def _of_hdf5(path: Path) -> Found:
    record, about = hdf5.read_described(path)
    del about["file"], about["bytes"]
    if isinstance(record, Reconstruction):
        about["trust"] = record.trust
    written = (
        "written",
        f"{about['created']} by {about['creator']} {about['creator_version']}, format {about['format']}",
    )
    return about.pop("kind"), [*summarise(record), written], about


def _of_toml(path: Path) -> Found:
    if is_study(read_toml(path, MAX_STUDY_MB)):
        study = load_study(path)
        rows = [*study.rows, ("points", f"{len(study.points())} ({study.design})")]
        return "study", rows, {"settings": study.model_dump(mode="json")}
    if not is_scene(read_tables(path)):
        instrument = load_instrument(path)
        return "instrument", summarise(instrument), {"settings": instrument.model_dump(mode="json", exclude_none=True)}
    scene = load_scene(path)
    return "scene", summarise(scene) + _trace_rows(scene), {"settings": resolved(scene)}


def _trace_rows(scene: SceneFile) -> Rows:
    t = scene.trace
    stands = f"counts of {plural(scene.scan.atoms_per_pixel, 'beam atom')} per pixel"
    stands = stands if t.estimator == "expected" else f"counts of the {t.rays} atoms"
    return [("tracing", f"{t.rays} rays per pixel, {t.estimator} estimator, seed {t.seed}; {stands}")]


def _of_matlab(path: Path) -> Found:
    found = describe_matlab(path)
    rows = [("micrographs", f"{found['kind']}; read them with helio import --instrument FILE.toml")]
    for name, image in found["images"].items():
        size = " x ".join(map(str, reversed(image["shape"])))
        state = "only zeros: not connected" if image["max"] == image["min"] == 0 else ""
        numbers = f"mean {image['mean']:.4g}, {image['min']:.4g} to {image['max']:.4g}"
        rows.append((name, f"{size} (columns x rows), {state or numbers}"))
    rows += [(label, text) for label, text in found["numbers"].items()]
    return f"MATLAB file, {found['kind']}", rows, {"metadata": found["metadata"]}


def _of_mesh(path: Path) -> Found:
    vertices, faces, _ = load_mesh(path, MeshSample.model_fields["max_file_mb"].default)
    found = check_body(Body(vertices, faces))
    low, high = found.pop("bounds_um")
    sides = " x ".join(f"{b - a:.6g}" for a, b in zip(low, high, strict=True))
    place = ", ".join(f"{axis} {a:.6g} to {b:.6g}" for axis, a, b in zip("xyz", low, high, strict=True))
    rows = [("mesh", f"{found['n_faces']} triangles, {found['n_vertices']} vertices")]
    rows += [("size", f"{sides} in the file's unit (sample.unit in a scene)"), ("extent", place)]
    closed = "yes" if found["is_watertight"] else f"no: {found['n_inner_open_edges']} open edges within"
    rows.append(("closed", f"{closed}; {found['n_open_edges'] - found['n_inner_open_edges']} on its outer border"))
    for hole in found["holes"][:1]:
        middle = ", ".join(f"{v:.6g}" for v in hole["middle_um"])
        size = f"the largest is {hole['size_um']:.6g} across, middle at {middle}"
        rows.append(("holes", f"{found['n_holes']}; {size} (a scene closes small ones: sample.close_holes_um)"))
    faults = {"n_edges_of_three_faces": "edges of three faces", "n_duplicate_faces": "faces given twice"}
    shown = [f"{found[key]} {words}" for key, words in faults.items() if found[key]]
    if not found["is_winding_consistent"]:
        shown.append("neighbouring faces are wound in opposite senses")
    return "mesh", [*rows, ("faults", ", ".join(shown) or "none found")], {**found, "bounds": [low, high]}


def _of_npz(path: Path) -> Found:
    check_file(path, MAX_HEIGHT_MAP_MB)
    try:
        with zipfile.ZipFile(path) as archive:
            sizes = {entry.filename.removesuffix(".npy"): entry.file_size for entry in archive.infolist()}
    except Exception as e:  # zipfile raises many kinds on corrupt files
        raise InputFileError(f"{path}: is not a readable .npz file: {e}; write it again") from None
    if {"x", "y", "height"} <= sizes.keys():
        rows = summarise(read_height_map(path, 1.0, None))
        return "height map", [*rows, ("unit", "um is assumed here; a scene states it (sample.unit)")], {"arrays": sizes}
    rows = [(name, f"{size:,} bytes unpacked") for name, size in sizes.items()]
    uses = "rays of a beam" if {"position", "direction"} <= sizes.keys() else "not a file that a scene reads"
    return "NumPy arrays", [*rows, ("use", uses)], {"arrays": sizes}


def _of_npy(path: Path) -> Found:
    try:
        found = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, EOFError, OSError) as e:
        raise InputFileError(f"{path}: is not a readable .npy file: {e}") from None
    shape = list(found.shape)
    rows = [("array", f"{' x '.join(map(str, shape))} of {found.dtype}")]
    return "NumPy array", [*rows, ("use", "rays of a beam: 6 or 7 columns")], {"shape": shape}


def _of_mtl(path: Path) -> Found:
    text = read_bytes(path, MAX_HEIGHT_MAP_MB).decode("utf-8", "replace")
    laws: dict[str, str] = {}
    for word, value in re.findall(r"^\s*(newmtl|helio_law)\s+(.+?)\s*$", text, re.MULTILINE):
        if word == "newmtl":
            laws[value] = "no helio_law: the sample's material"
        elif laws:
            laws[list(laws)[-1]] = value
    if not laws:
        raise InputFileError(f"{path}: names no material (newmtl)")
    return "materials of an OBJ mesh", list(laws.items()), {"laws": laws}


def _of_table(path: Path) -> Found:
    check_file(path, MAX_HEIGHT_MAP_MB)
    with path.open("rb") as file:
        head = file.read(4096)
    first = head.decode("utf-8-sig", "replace").splitlines()[0]
    names = [name.strip() for name in first.split(",")]
    if names == HEADER:
        views = read_points(path)
        rows = [(view, ", ".join(points)) for view, points in views.items()]
        return "control points", rows, {"points": views}
    words = re.sub(r"(?i)[-+]?\b(nan|inf|infinity)\b", "", first)  # which are numbers
    has_names = re.search(r"[A-Za-z_]{2}", words) is not None and not first.lstrip().startswith("#")
    separator = "," if path.suffix.lower() == ".csv" else None
    titles = first.replace(" ", "") if has_names else ""
    try:
        table = read_table(path, MAX_HEIGHT_MAP_MB, "a table of numbers", separator=separator, titles=titles)
    except InputFileError:
        if not (has_names and separator):
            raise
        return _of_words(path, names)
    if not table.size:
        raise InputFileError(f"{path}: holds no numbers below its titles: write it again")
    n_rows, n_columns = table.shape
    rows = [("table", f"{n_rows} lines of {plural(n_columns, 'number')}")]
    if not has_names and n_columns > 7:
        low, high = float(np.nanmin(table)), float(np.nanmax(table))
        rows.append(("values", f"{low:.6g} to {high:.6g}, {int(np.isnan(table).sum())} missing"))
        return (
            "grid of numbers",
            [*rows, ("use", "a height map (sample.kind = 'height_map')")],
            {"shape": [n_rows, n_columns]},
        )
    labels = names if has_names and len(names) == n_columns else [f"column {i + 1}" for i in range(n_columns)]
    rows += _columns(labels, [f"{np.nanmin(column):.6g} to {np.nanmax(column):.6g}" for column in table.T[:_MANY]])
    uses = {2: "beam positions x, y in um", 3: "a scattering table (theta, phi, intensity)"}
    uses |= {4: "a scattering table (incidence, theta, phi, intensity)", 6: "rays of a beam", 7: "rays with weights"}
    use = [] if has_names and names != ["x_um", "y_um"] else [("use", uses.get(n_columns, "none known"))]
    return "table of numbers", rows + use, {"shape": [n_rows, n_columns], "columns": labels}


def _of_words(path: Path, names: list[str]) -> Found:
    """Find out what a table with columns of words holds, such as those of `helio measure --table`."""
    lines = [row for _, row in read_rows(path, names)][1:]
    if not lines:
        raise InputFileError(f"{path}: holds nothing below its titles: write it again")
    rows = [("table", f"{plural(len(lines), 'line')} of {plural(len(names), 'column')}")]
    rows += _columns(names, [_range_or_words(cells) for cells in list(zip(*lines, strict=True))[:_MANY]])
    return "table", rows, {"shape": [len(lines), len(names)], "columns": names}


def _columns(labels: list[str], texts: list[str]) -> Rows:
    """Label the texts of the first columns, and name the others."""
    further = [("further columns", ", ".join(labels[_MANY:]))] if len(labels) > _MANY else []
    return [*zip(labels, texts, strict=False), *further]


def _range_or_words(cells: tuple[str, ...]) -> str:
    """Write the range of numbers, or the most frequent words."""
    try:
        numbers = np.array([float(cell) for cell in cells if cell])
    except ValueError:
        found = Counter(textwrap.shorten(cell, 40, placeholder=" ...") for cell in cells).most_common(_MANY_WORDS + 1)
        shown = ", ".join(f"{word or 'nothing'} ({n})" for word, n in found[:_MANY_WORDS])
        return f"{shown}, ..." if len(found) > _MANY_WORDS else shown
    known = numbers[np.isfinite(numbers)]
    return f"{known.min():.6g} to {known.max():.6g}" if known.size else "no number"
