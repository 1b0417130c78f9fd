"""Read scene and instrument files (TOML) and validate them, with all errors reported at once.

`SceneFile` composes the settings models of all stages. Loading a scene imports neither JAX nor the tracer.
"""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from helio_jax.arguments import checked
from helio_jax.calibration.noise import NoiseSettings
from helio_jax.errors import SceneError
from helio_jax.instrument import Instrument
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.planning.design_settings import DesignSettings
from helio_jax.reconstruction import Reconstruction
from helio_jax.scene.files import read_toml
from helio_jax.scene.scan import with_scan_kind
from helio_jax.scene.scene import Scene
from helio_jax.scores.settings import TruthSettings
from helio_jax.trace.settings import TraceSettings
from helio_jax.workflows.merge import APPEND, Replaced, append, merge, nest
from helio_jax.workflows.scene_errors import explain_errors
from helio_jax.workflows.shipped import locate

MAX_SCENE_MB = 1.0
"""Largest scene file."""
SCENE_TABLES = frozenset(("sample", "scan"))
"""Tables that a scene needs; an instrument file has neither."""


class SceneFile(Scene):
    """All tables of a scene file."""

    trace: TraceSettings = TraceSettings()
    noise: NoiseSettings = NoiseSettings()
    reconstruct: ReconstructSettings = ReconstructSettings()
    truth: TruthSettings = TruthSettings()
    design: DesignSettings = DesignSettings()

    def _problems(self) -> list[str]:
        problems = super()._problems()
        if self.plate.is_mesh and self.trace.estimator != "analog":
            problems.append(
                f"trace.estimator = {self.trace.estimator!r}: with a plate of kind 'mesh' only whole atoms are "
                "counted: set trace.estimator = 'analog'"
            )
        return problems + [f"noise.{key}: {text}" for key, text in self.noise.problems(len(self.detector))]


@checked
def load_scene(path: str | os.PathLike, overrides: Mapping[str, Any] | None = None) -> SceneFile:
    """Read a scene file.

    Args:
        path: of the TOML file, or the name of a scene that comes with the program ("sphere_a"; `helio scenes`).
            `extends = "FILE"` (relative to it, or such a name) names one file whose tables it overrides.
        overrides: values that override the file: nested tables, or dotted keys as in {"trace.rays": 1000}
            and {"sample.spheres.0.radius_um": 500.0}.

    Raises:
        SceneError: missing, too large, not UTF-8, not TOML, or invalid; the message lists all errors.

    Example:
        >>> hx.load_scene("sphere_a", {"scan.nx": 61})
    """
    path = locate(path)
    tables = merge(read_tables(path), nest(overrides or {}))
    data = {"name": path.stem[:200], **with_scan_kind(tables)}
    try:
        scene = SceneFile.model_validate(data, context={"read_reconstruction": read_reconstruction})
    except ValidationError as e:
        notes = replaced_lists(path)
        if not is_scene(tables):
            notes = ["this is an instrument file, without [sample] and [scan]: a scene may extend it", *notes]
        raise SceneError("\n  ".join([explain_errors(str(path), e, SceneFile, data), *notes])) from None
    return scene.with_base_dir(path.parent).with_sample_distance()


def files_read(
    path: str | os.PathLike, label: str, overrides: Mapping[str, Any] | None = None
) -> list[tuple[str, Path]]:
    """Return what names each file that a scene or instrument file has read, and its path; the file itself first.

    Beside an OBJ every .mtl counts. Nothing is checked: errors in the file are reported when it is loaded.
    """
    names: list[str] = []
    try:
        path = locate(path)
        _, _, base_path = _read_layers(path)
        tables = merge(read_tables(path), nest(overrides or {}))
    except SceneError:
        return [(label, Path(path))]
    with_files(tables, lambda name: names.append(name) or name)
    found = [*([base_path] if base_path else []), *(path.parent / name for name in names)]
    found += [mtl for obj in found if obj.suffix.lower() == ".obj" for mtl in obj.parent.glob("*.mtl")]
    return [(label, path), *((f"{label}: a file of {path.name}", file) for file in found)]


def read_reconstruction(path: Path) -> Reconstruction:
    """Read a reconstruction for samples of kind "reconstruction".

    Raises:
        InputFileError: missing, damaged, or no reconstruction.
    """
    from helio_jax.formats.hdf5 import read_height

    return read_height(path)


@checked
def load_instrument(path: str | os.PathLike, overrides: Mapping[str, Any] | None = None) -> Instrument:
    """Read the instrument of an instrument file, or of any scene file.

    Args:
        path: of the TOML file, or a name ("bshem"), as in `load_scene`.
        overrides: values that override the file, as in `load_scene`.

    Raises:
        SceneError: as `load_scene`; only the tables beam, plate, uncertainty and detector are checked.

    Example:
        >>> hx.load_instrument("bshem", {"beam.incidence_deg": 29.0})
    """
    path = locate(path)
    data = merge(read_tables(path), nest(overrides or {}))
    known = set(SceneFile.model_fields) - set(Instrument.model_fields)
    tables = {key: value for key, value in data.items() if key not in known}
    try:
        return Instrument.model_validate(tables)
    except ValidationError as e:
        errors = explain_errors(str(path), e, Instrument, tables)
        raise SceneError("\n  ".join([errors, *replaced_lists(path)])) from None


def is_scene(tables: Mapping[str, Any]) -> bool:
    """Whether the tables of a file are those of a scene; else they are those of an instrument."""
    return not SCENE_TABLES.isdisjoint(tables)


def is_study(tables: Mapping[str, Any]) -> bool:
    """Whether the tables of a file are those of a study: a scene's name, and what varies."""
    return "scene" in tables and not {"vary", "case"}.isdisjoint(tables)


def resolved(scene: Scene) -> dict[str, Any]:
    """Return all settings of a scene, defaults included, JSON-compatible, for `SceneFile.model_validate`."""
    return scene.model_dump(mode="json")


def json_schema() -> dict[str, Any]:
    """Generate the JSON schema of a scene file, for editors and `helio schema`."""
    schema = SceneFile.model_json_schema()
    properties = {
        "extends": {
            "type": "string",
            "description": "Scene or instrument whose tables this file overrides: a file, relative to this one, or a "
            "name of helio scenes",
        },
        APPEND: {"type": "object", "description": "Lists, as [[append.detector]], that are added to those it extends"},
    }
    schema["properties"] = properties | schema["properties"]
    return schema


def read_tables(path: Path) -> dict[str, Any]:
    """Read a scene or instrument file as tables, merged over the file that it extends; nothing else is checked.

    Raises:
        SceneError: missing, too large, not UTF-8, not TOML, or a study.
    """
    base, own, _ = _read_layers(path)
    if is_study(own):
        raise SceneError(
            f"{path}: this is a study of the scene {own['scene']!r}: helio study runs it, helio info and helio "
            "validate describe and check it"
        )
    more = own.pop(APPEND, {})
    try:
        return append(merge(base, own), more)
    except SceneError as e:
        raise SceneError(f"{path}: {e}") from None


def replaced_lists(path: Path) -> list[str]:
    """Describe each list of tables by which a file replaces that of the file that it extends."""
    base, own, base_path = _read_layers(path)
    replaced: Replaced = []
    merge(base, own, replaced)
    return [
        f"[[{key}]] ({after} here) replaces all {before} of {base_path}; to add to them write [[{APPEND}.{key}]]"
        for key, before, after in replaced
    ]


def _read_layers(path: Path) -> tuple[dict[str, Any], dict[str, Any], Path | None]:
    """Read the tables of the file that a file extends, its own tables without `extends`, and the path of the former."""
    data = read_toml(path, MAX_SCENE_MB)
    if "extends" not in data:
        if APPEND in data:
            raise SceneError(f"{path}: {APPEND} adds to the lists of another file: name it with extends")
        return {}, data, None
    name = data.pop("extends")
    if not isinstance(name, str):
        raise SceneError(f"{path}: extends must be the name of one TOML file in quotes, got {name!r}")
    try:
        base_path = locate(name, path.parent)
        base = read_toml(base_path, MAX_SCENE_MB)
    except SceneError as e:
        raise SceneError(f"{path}: extends = {name!r}: {e}") from None
    if "extends" in base:
        raise SceneError(
            f"{path}: extends = {name!r}: that file extends {base['extends']!r} itself; only one level is allowed: "
            "merge the two files, or change a copy"
        )

    def relative_to_scene(name: str) -> str:
        if Path(name).is_absolute():
            return name
        return Path(os.path.relpath(base_path.parent / name, path.parent)).as_posix()

    return with_files(base, relative_to_scene), data, base_path


def with_files(tables: Mapping[str, Any], change: Callable[[str], str]) -> dict[str, Any]:
    """Apply `change` to all file names in a scene's tables."""

    def changed(node: Any) -> Any:
        if isinstance(node, list):
            return [changed(child) for child in node]
        if not isinstance(node, dict):
            return node
        return {
            key: change(child) if key == "file" and isinstance(child, str) else changed(child)
            for key, child in node.items()
        }

    tables_with_files = ("beam", "plate", "sample", "material", "scan")
    return {key: changed(node) if key in tables_with_files else node for key, node in tables.items()}
