"""Scattering laws from the .mtl file of an OBJ mesh. Below `newmtl NAME`, besides optical keys, which are ignored:

    helio_law broad_specular
    helio_sigma_deg 20
    helio_diffuse_fraction 0.5

helio_law is the `kind` of a scene's table [material.NAME], every other helio_KEY one of its keys, with a value as in
TOML (a single word needs no quotes). A scene's table [material.NAME] overrides the file's material of that name.
"""

import contextlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from helio_jax.errors import InputFileError
from helio_jax.scene.body import COSINE
from helio_jax.scene.files import read_bytes
from helio_jax.scene.scattering import Law
from helio_jax.texts import parse_value

MAX_MTL_MB = 16.0
"""Largest .mtl file."""
MAX_MTL_FILES = 100
"""Largest number of .mtl files that an OBJ file names."""
_LAW: TypeAdapter = TypeAdapter(Law)
_PREFIX = "helio"


@dataclass(frozen=True)
class FileLaw:
    """A law from a .mtl file: name of its material there, settings, and the folder of the law's own file names."""

    name: str
    law: Any
    folder: Path


def mtl_files(obj: Path, data: bytes) -> tuple[list[Path], list[str]]:
    """Find the .mtl files that an OBJ file names (mtllib): paths of existing ones, names of missing ones.

    Folders in the names are ignored: files are untrusted, only files beside the OBJ are read.

    Raises:
        InputFileError: it names more than `MAX_MTL_FILES`.
    """
    found, missing = [], []
    lines = list(dict.fromkeys(re.findall(rb"^[ \t]*mtllib[ \t]+(.+?)[ \t\r]*$", data, re.MULTILINE)))
    if len(lines) > MAX_MTL_FILES:
        raise InputFileError(f"{obj}: names {len(lines)} .mtl files, the limit is {MAX_MTL_FILES}: join them")
    for line in lines:
        text = line.decode("utf-8", "replace")
        for name in [text] if text.count(".mtl") == 1 else text.split()[:MAX_MTL_FILES]:
            path = obj.parent / name.replace("\\", "/").rpartition("/")[2]
            with contextlib.suppress(ValueError, OSError):  # a name that no file can have
                (found if path.is_file() else missing).append(path)
    return list(dict.fromkeys(found)), [path.name for path in dict.fromkeys(missing)]


def used_laws(obj: Path, data: bytes) -> dict[str, FileLaw]:
    """Read the laws of the materials that an OBJ file uses, by the names of the materials.

    Raises:
        InputFileError: a .mtl file cannot be read or holds a wrong law.
    """
    used = {
        name.decode("utf-8", "replace")
        for name in re.findall(rb"^[ \t]*usemtl[ \t]+(.+?)[ \t\r]*$", data, re.MULTILINE)
    }
    laws: dict[str, FileLaw] = {}
    for path in mtl_files(obj, data)[0]:
        laws |= {name: law for name, law in read_mtl(path).items() if name in used}
    return laws


def read_mtl(path: Path) -> dict[str, FileLaw]:
    """Read the laws of all materials of a .mtl file that have helio_law.

    Raises:
        InputFileError: as `read_bytes`; an unknown law or key, a value out of range: with file and line.
    """
    text = read_bytes(path, MAX_MTL_MB).decode("utf-8", "replace")
    keys: dict[str, tuple[int, str]] = {}
    name, out = "", {}
    for number, line in enumerate([*text.splitlines(), "newmtl"], 1):
        word, _, value = line.strip().partition(" ")
        value = value.split("#")[0].strip()
        if word == "newmtl":
            if keys:
                out[name] = FileLaw(name, _law(path, name, keys), path.parent)
            keys, name = {}, value
        elif word.lower().startswith(_PREFIX):
            _check_place(path, number, word, name, keys)
            keys[word.removeprefix(f"{_PREFIX}_")] = number, value
    return out


def _check_place(path: Path, number: int, word: str, name: str, keys: dict[str, tuple[int, str]]) -> None:
    """Refuse a key without a material, a repeated key, or a misspelt one."""
    key = word.removeprefix(f"{_PREFIX}_")
    where = f"{path}, line {number}: {word}"
    if not word.startswith(f"{_PREFIX}_") or key == "kind":
        raise InputFileError(f"{where}: keys are written helio_law and helio_KEY, in lower case: correct it")
    if name in ("", COSINE):
        wrong = "stands before any newmtl NAME" if not name else f"{COSINE!r} is reserved for the cosine law"
        raise InputFileError(f"{where}: {wrong}: put it below a newmtl NAME of another name")
    if key in keys:
        raise InputFileError(f"{where}: {name!r} has it already in line {keys[key][0]}: remove one of them")


def _law(path: Path, name: str, keys: dict[str, tuple[int, str]]) -> Any:
    """Construct the law from the keys of a material (line number and text of each)."""
    first = min(number for number, _ in keys.values())
    if "law" not in keys:
        raise InputFileError(
            f"{path}, line {first}: the material {name!r} has no helio_law: add one, the kind of its scattering law"
        )
    table = {key: parse_value(text) for key, (_, text) in keys.items() if key != "law"}
    kind = keys["law"][1].strip("\"'")
    try:
        return _LAW.validate_python({"kind": kind, **table})
    except ValidationError as e:
        problem = e.errors(include_url=False)[0]
        raise InputFileError(f"{path}, {_sentence(problem, kind, keys)}") from None


def _sentence(problem: Any, kind: str, keys: dict[str, tuple[int, str]]) -> str:
    """Format the error message: line, key, reason."""
    inner = [str(part) for part in problem["loc"] if part != kind]
    key = inner[0] if inner else "law"
    if problem["type"] == "union_tag_invalid":
        return f"line {keys['law'][0]}: helio_law {kind}: must be one of {problem['ctx']['expected_tags']}"
    if problem["type"] == "missing" and key not in keys:
        return f"line {keys['law'][0]}: helio_law {kind} needs helio_{key}: add the line"
    number, text = keys.get(key, keys["law"])
    if problem["type"] == "extra_forbidden":
        return f"line {number}: helio_{key}: the law {kind!r} has no such key: correct or remove it (helio schema)"
    reason = str(problem["ctx"]["error"]) if problem["type"] == "value_error" else problem["msg"].lower()
    return f"line {number}: helio_{'.'.join(inner) or 'law'} {text[:60]}: {reason.removeprefix('input ')}: correct it"
