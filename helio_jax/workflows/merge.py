"""Merge the tables of scene and instrument files: over an extended file, and with overrides.

Tables are merged key by key; a list replaces a list. The table `append` of a file mirrors its structure and adds to
lists instead: `[[append.detector]]`, `[[append.sample.spheres]]`.
"""

from collections.abc import Mapping
from typing import Any

from helio_jax.errors import SceneError
from helio_jax.texts import MAX_DEPTH

APPEND = "append"
"""Table whose lists are added to those of the extended file."""
SHARED_KEYS = ("plate",)
"""Tables whose kinds share their keys."""

Replaced = list[tuple[str, int, int]]
"""Lists of tables that were replaced: key, entries before and after."""


def merge(
    base: Mapping[str, Any], over: Mapping[str, Any], replaced: Replaced | None = None, above: str = ""
) -> dict[str, Any]:
    """Merge tables recursively; other values, and tables of another `kind` (except `SHARED_KEYS`), are replaced.

    An index from 0 selects an element of an array ({"spheres": {"0": ...}}).

    Args:
        base: tables beneath.
        over: tables above, which win.
        replaced: takes a row for every list of tables that is replaced.
        above: path of the tables in the file, for those rows.
    """
    out = dict(base)
    for key, value in over.items():
        old, where = out.get(key), f"{above}{key}"
        both = isinstance(old, Mapping) and isinstance(value, Mapping)
        if both and (key in SHARED_KEYS or value.get("kind", old.get("kind")) == old.get("kind")):  # type: ignore[union-attr]
            out[key] = merge(old, value, replaced, f"{where}.")  # type: ignore[arg-type]
        elif isinstance(old, list) and isinstance(value, Mapping) and all(_is_index(k, old) for k in value):
            elements = dict(zip(map(str, range(len(old))), old, strict=True))
            out[key] = list(merge(elements, value, replaced, f"{where}.").values())
        else:
            out[key] = value
            if replaced is not None and isinstance(value, list) and _is_tables(old):
                replaced.append((where, len(old), len(value)))  # type: ignore[arg-type]
    return out


def append(tables: Mapping[str, Any], more: Any, above: str = "") -> dict[str, Any]:
    """Add the lists of `more`, a tree of the same structure, to those of the tables.

    Raises:
        SceneError: there is no such list to add to, or something else than a list is added.
    """
    if not isinstance(more, Mapping):
        raise SceneError(f"{APPEND}: must be a table of lists, got {more!r}: write for example [[{APPEND}.detector]]")
    out = dict(tables)
    for key, value in more.items():
        old, where = out.get(key), f"{above}{key}"
        if isinstance(old, list) and isinstance(value, list):
            out[key] = [*old, *value]
        elif isinstance(old, Mapping) and isinstance(value, Mapping):
            out[key] = append(old, value, f"{where}.")
        elif isinstance(old, (list, type(None))):
            wrong = "must be a list" if isinstance(old, list) else "the extended file has no such list"
            raise SceneError(f"{APPEND}.{where}: {wrong}: add with [[{APPEND}.{where}]], begin a list with [[{where}]]")
        else:
            raise SceneError(f"{APPEND}.{where}: {where} is no list: set it in its own table")
    return out


def nest(overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Convert dotted keys to nested tables.

    Raises:
        SceneError: a key has more than `MAX_DEPTH` parts.
    """
    out: dict[str, Any] = {}
    for key, value in overrides.items():
        if key.count(".") >= MAX_DEPTH:
            raise SceneError(f"{key[:60]}...: a key has at most {MAX_DEPTH} parts: correct it (helio schema)")
        first, _, rest = key.partition(".")
        nested = {rest: value} if rest else value
        out = merge(out, {first: nest(nested) if isinstance(nested, Mapping) else nested})
    return out


def _is_index(key: str, array: list) -> bool:
    """Whether a key is the index of an element."""
    return key.isdecimal() and len(key) < 10 and str(int(key)) == key and int(key) < len(array)


def _is_tables(value: Any) -> bool:
    """Whether a value is a list of tables."""
    return isinstance(value, list) and any(isinstance(element, Mapping) for element in value)
