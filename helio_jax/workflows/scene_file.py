"""Read scene and instrument files (TOML) and validate them, with all errors reported at once.

`SceneFile` composes the settings models of all stages. Loading a scene imports neither JAX nor the tracer.
"""

import os
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from helio_jax.calibration.noise import NoiseSettings
from helio_jax.errors import SceneError
from helio_jax.instrument import Instrument
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.reconstruction import Reconstruction
from helio_jax.scene.files import read_bytes
from helio_jax.scene.scan import with_scan_kind
from helio_jax.scene.scene import Scene
from helio_jax.scores.settings import TruthSettings
from helio_jax.trace.settings import TraceSettings
from helio_jax.workflows.scene_errors import explain_errors

MAX_SCENE_MB = 1.0
"""Largest scene file."""
SHARED_KEYS = ("plate",)
"""Tables whose kinds share their keys."""


class SceneFile(Scene):
    """All tables of a scene file."""

    trace: TraceSettings = TraceSettings()
    noise: NoiseSettings = NoiseSettings()
    reconstruct: ReconstructSettings = ReconstructSettings()
    truth: TruthSettings = TruthSettings()

    def _problems(self) -> list[str]:
        problems = super()._problems()
        if self.plate.is_mesh and self.trace.estimator != "analog":
            problems.append(
                f"trace.estimator = {self.trace.estimator!r}: with a plate of kind 'mesh' only whole atoms are "
                "counted: set trace.estimator = 'analog'"
            )
        return problems + [f"noise.{key}: {text}" for key, text in self.noise.problems(len(self.detector))]


def load_scene(path: str | os.PathLike, overrides: Mapping[str, Any] | None = None) -> SceneFile:
    """Read a scene file.

    Args:
        path: of the TOML file. `extends = "FILE"` (relative to it) names one file whose tables it overrides.
        overrides: values that override the file: nested tables, or dotted keys as in {"trace.rays": 1000}
            and {"sample.spheres.0.radius_um": 500.0}.

    Raises:
        SceneError: missing, too large, not UTF-8, not TOML, or invalid; the message lists all errors.
    """
    path = Path(path)
    data = {"name": path.stem[:200], **with_scan_kind(_merge(read_tables(path), _nest(overrides or {})))}
    try:
        scene = SceneFile.model_validate(data, context={"read_reconstruction": read_reconstruction})
    except ValidationError as e:
        raise SceneError(explain_errors(str(path), e, SceneFile, data)) from None
    return scene.with_base_dir(path.parent).with_sample_distance()


def files_read(
    path: str | os.PathLike, label: str, overrides: Mapping[str, Any] | None = None
) -> list[tuple[str, Path]]:
    """Return what names each file that a scene or instrument file has read, and its path; the file itself first.

    Beside an OBJ every .mtl counts. Nothing is checked: errors in the file are reported when it is loaded.
    """
    path = Path(path)
    names: list[str] = []
    try:
        extended = _read_toml(path).get("extends")
        tables = _merge(read_tables(path), _nest(overrides or {}))
    except SceneError:
        return [(label, path)]
    with_files(tables, lambda name: names.append(name) or name)
    found = [path.parent / name for name in ([extended] if isinstance(extended, str) else []) + names]
    found += [mtl for obj in found if obj.suffix.lower() == ".obj" for mtl in obj.parent.glob("*.mtl")]
    return [(label, path), *((f"{label}: a file of {path.name}", file) for file in found)]


def read_reconstruction(path: Path) -> Reconstruction:
    """Read a reconstruction for samples of kind "reconstruction".

    Raises:
        InputFileError: missing, damaged, or no reconstruction.
    """
    from helio_jax.formats.hdf5 import read_height

    return read_height(path)


def load_instrument(path: str | os.PathLike) -> Instrument:
    """Read the instrument of an instrument file, or of any scene file.

    Raises:
        SceneError: as `load_scene`; only the tables beam, plate, uncertainty and detector are checked.
    """
    data = read_tables(Path(path))
    known = set(SceneFile.model_fields) - set(Instrument.model_fields)
    tables = {key: value for key, value in data.items() if key not in known}
    try:
        return Instrument.model_validate(tables)
    except ValidationError as e:
        raise SceneError(explain_errors(str(path), e, Instrument, tables)) from None


def resolved(scene: Scene) -> dict[str, Any]:
    """Return all settings of a scene, defaults included, JSON-compatible, for `SceneFile.model_validate`."""
    return scene.model_dump(mode="json")


def json_schema() -> dict[str, Any]:
    """Generate the JSON schema of a scene file, for editors and `helio schema`."""
    schema = SceneFile.model_json_schema()
    text = "Scene or instrument file, relative to this one, whose tables this file overrides"
    schema["properties"] = {"extends": {"type": "string", "description": text}, **schema["properties"]}
    return schema


def read_tables(path: Path) -> dict[str, Any]:
    """Read a scene or instrument file as tables, merged over the file that it extends; nothing else is checked.

    Raises:
        SceneError: missing, too large, not UTF-8 or not TOML.
    """
    data = _read_toml(path)
    if "extends" not in data:
        return data
    name = data.pop("extends")
    if not isinstance(name, str):
        raise SceneError(f"{path}: extends must be the name of one TOML file in quotes, got {name!r}")
    base_path = path.parent / name
    try:
        base = _read_toml(base_path)
    except SceneError as e:
        raise SceneError(f"{path}: extends = {name!r}: {e}") from None
    if "extends" in base:
        raise SceneError(
            f"{path}: extends = {name!r}: that file extends {base['extends']!r} itself; only one level is allowed: "
            "merge the two files"
        )

    def relative_to_scene(name: str) -> str:
        if Path(name).is_absolute():
            return name
        return Path(os.path.relpath(base_path.parent / name, path.parent)).as_posix()

    return _merge(with_files(base, relative_to_scene), data)


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


def _read_toml(path: Path) -> dict[str, Any]:
    """Read one TOML file; numbers must be finite."""
    raw = read_bytes(path, MAX_SCENE_MB, SceneError)
    try:
        return tomllib.loads(raw.decode("utf-8-sig"))
    except UnicodeDecodeError as e:
        line = raw[: e.start].count(b"\n") + 1
        text = f"{path}: is not UTF-8 text (byte {raw[e.start]:#04x} in line {line}): save it as UTF-8"
        raise SceneError(text) from None
    except tomllib.TOMLDecodeError as e:
        raise SceneError(f"{path}: is not valid TOML: {e}") from None
    except RecursionError:
        raise SceneError(f"{path}: is nested too deeply: a scene has tables of plain values") from None


def _merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Merge tables recursively; other values, and tables of another `kind` (except `SHARED_KEYS`), are replaced.

    An index from 0 selects an element of an array ({"spheres": {"0": ...}}).
    """
    out = dict(base)
    for key, value in over.items():
        old = out.get(key)
        both = isinstance(old, Mapping) and isinstance(value, Mapping)
        if both and (key in SHARED_KEYS or value.get("kind", old.get("kind")) == old.get("kind")):  # type: ignore[union-attr]
            out[key] = _merge(old, value)  # type: ignore[arg-type]
        elif isinstance(old, list) and isinstance(value, Mapping) and all(_is_index(k, old) for k in value):
            out[key] = list(_merge(dict(zip(map(str, range(len(old))), old, strict=True)), value).values())
        else:
            out[key] = value
    return out


def _is_index(key: str, array: list) -> bool:
    """Whether a key is the index of an element."""
    return key in map(str, range(len(array)))


def _nest(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Convert dotted keys to nested tables."""
    out: dict[str, Any] = {}
    for key, value in overrides.items():
        first, _, rest = key.partition(".")
        nested = {rest: value} if rest else value
        out = _merge(out, {first: _nest(nested) if isinstance(nested, Mapping) else nested})
    return out
