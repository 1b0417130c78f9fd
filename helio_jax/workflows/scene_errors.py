"""Format pydantic's validation errors of scene and instrument files: key, value, limit, remedy."""

import re
from collections.abc import Iterator, Mapping
from typing import Any, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo

from helio_jax.spelling import did_you_mean

_UNIT = re.compile(r"_(um|nm|deg|mrad|mev|mb)$")
_SIGNS = {"greater_than": (">", "gt"), "greater_than_equal": (">=", "ge"), "less_than": ("<", "lt")}
_SIGNS["less_than_equal"] = ("<=", "le")
_KINDS = {"float": "a number", "int": "a whole number", "bool": "true or false", "string": "a text in quotes"}
_KINDS |= {"tuple": "a list in brackets", "model": "a table", "finite": "a finite number", "dict": "a table"}
MAX_SHOWN = 50
"""Largest number of errors listed."""


def explain_errors(source: str, error: ValidationError, model: type[BaseModel], data: Mapping[str, Any]) -> str:
    """Format one message that lists all errors.

    Args:
        source: name of the file.
        error: raised by validating `data`.
        model: the validated model.
        data: the validated tables.
    """
    lines: list[str] = []
    n_more = 0
    for item in error.errors(include_url=False):
        if len(lines) >= MAX_SHOWN:
            n_more += 1
            continue
        loc = _without_tags(item["loc"], data)
        if item["type"] in ("too_short", "too_long") and not _has_wrong_length(item):
            continue  # pydantic reports a list with invalid items as too short, too
        lines += _explain(item, loc, model, data)
    n = len(lines) + n_more
    shown = lines[:MAX_SHOWN] + ([f"... and {n - MAX_SHOWN} more"] if n > MAX_SHOWN else [])
    return f"{source}: {n} error{'s' if n != 1 else ''}:\n" + "\n".join(f"  {line}" for line in shown)


def _explain(item: Any, loc: tuple, model: type[BaseModel], data: Mapping[str, Any]) -> Iterator[str]:
    """Yield the messages for one error of pydantic's list."""
    where, kind, context, value = _path(loc), item["type"], item.get("ctx", {}), item["input"]
    parent, field = _find(model, loc, data)
    key = next((part for part in reversed(loc) if isinstance(part, str)), "")
    unit = f" {_UNIT.search(key)[1]}".replace("mev", "meV") if _UNIT.search(key) else ""  # type: ignore[index]
    about = f" ({_first_sentence(field.description)})" if field is not None and field.description else ""
    if kind == "value_error":
        for line in str(context["error"]).splitlines():
            yield f"{where}: {line}" if where else line
    elif kind == "extra_forbidden":
        known = [] if parent is None else list(parent.model_fields)
        remedy = did_you_mean(key, known) or f"remove it; known here: {', '.join(known)}"
        yield f"{where}: unknown key {key!r} (value {_show(value)}): {remedy}"
    elif kind == "missing":
        if loc and isinstance(loc[-1], int):
            yield f"{_path(loc[:-1])}: got {_show(value)}; element {loc[-1]} is missing: add it{about}"
        else:
            table = _path(loc[:-1])
            what = "table" if field is not None and _models(field.annotation) else "key"
            yield f"{where}: is missing: add the {what} {key!r}{f' to {table!r}' if table else ''}{about}"
    elif kind in ("literal_error", "union_tag_invalid"):
        value = value if kind == "literal_error" else context["tag"]
        expected = context["expected"] if kind == "literal_error" else context["expected_tags"]
        question = did_you_mean(str(value), re.findall(r"'([^']*)'", expected), 0.5)
        where = where if kind == "literal_error" else f"{where}.kind"
        yield f"{where} = {_show(value)}: must be one of {expected}" + (f": {question}" if question else "")
    elif kind == "union_tag_not_found":
        yield f"{where}.kind: is missing: say which, one of {', '.join(_tags(field))}"
    elif kind in _SIGNS:
        sign, name = _SIGNS[kind]
        limit = f"{_number(context[name])}{unit}"
        yield f"{where} = {_show(value)}: must be {sign} {limit}: {_remedy(field, unit)}{about}"
    elif kind in ("too_short", "too_long"):
        limit = context.get("min_length", context.get("max_length"))
        sign = "at least" if kind == "too_short" else "at most"
        remedy = "add entries" if kind == "too_short" else "remove entries"
        yield f"{where}: must have {sign} {limit} entries, got {context.get('actual_length')}: {remedy}{about}"
    else:
        expected = None if kind.startswith("string_too") else _KINDS.get(kind.split("_")[0])
        text = f"must be {expected}" if expected else item["msg"]
        yield f"{where} = {_show(value)}: {text}: correct it{about}"


def _without_tags(loc: tuple, data: Mapping[str, Any]) -> tuple:
    """Drop the union tags that pydantic puts into a path: ('sample', 'step', 'height_um')."""
    out: list[str | int] = []
    node: Any = data
    was_tag = False
    for part in loc:
        is_tag = isinstance(node, Mapping) and node.get("kind") == part and not was_tag
        was_tag = is_tag
        if not is_tag:
            out.append(part)
            node = _child(node, part)
    return tuple(out)


def _child(node: Any, part: str | int) -> Any:
    """Return the value at `part` of a table or list, or None."""
    if isinstance(node, Mapping):
        return node.get(part)
    if isinstance(node, (list, tuple)) and isinstance(part, int) and part < len(node):
        return node[part]
    return None


def _find(
    model: type[BaseModel], loc: tuple, data: Mapping[str, Any]
) -> tuple[type[BaseModel] | None, FieldInfo | None]:
    """Find the model that holds the key at `loc`, and the key's field (None: unknown)."""
    parent: type[BaseModel] | None = model
    field: FieldInfo | None = None
    node: Any = data
    is_name = False  # whether the last part was a user-defined name, as in material.NAME
    for i, part in enumerate(loc):
        node = _child(node, part)
        if isinstance(part, int):
            continue
        is_name = field is not None and get_origin(field.annotation) is dict and not is_name
        if is_name:
            continue
        if i > 0 and field is not None:
            kind = _child(_at(data, loc[:i]), "kind")
            parent = _choose(_models(field.annotation), kind)
        field = None if parent is None else parent.model_fields.get(part)
        if field is None:
            return parent, None
    return parent, field


def _at(data: Any, loc: tuple) -> Any:
    """Return the value at a path."""
    for part in loc:
        data = _child(data, part)
    return data


def _models(annotation: Any) -> list[type[BaseModel]]:
    """Find the models inside an annotation (tuples, unions, Annotated)."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [m for arg in get_args(annotation) for m in _models(arg)]


def _choose(models: list[type[BaseModel]], kind: Any) -> type[BaseModel] | None:
    """Return the model of that kind, or the only one."""
    for m in models:
        if "kind" in m.model_fields and m.model_fields["kind"].default == kind:
            return m
    return models[0] if len(models) == 1 else None


def _tags(field: FieldInfo | None) -> list[str]:
    """List the kinds of a union."""
    return [] if field is None else [repr(m.model_fields["kind"].default) for m in _models(field.annotation)]


def _has_wrong_length(item: Any) -> bool:
    """Whether the complete input, not only its valid part, has too few or too many entries."""
    context, value = item.get("ctx", {}), item["input"]
    if not hasattr(value, "__len__"):
        return True
    return len(value) < context.get("min_length", 0) or len(value) > context.get("max_length", float("inf"))


def _remedy(field: FieldInfo | None, unit: str) -> str:
    """Format the range that a field allows."""
    limits: dict[str, Any] = {}
    for part in () if field is None else (*field.metadata, *_nested_metadata(field.annotation)):
        for node in (part, *getattr(part, "metadata", ())):
            limits |= {k: v for k in ("gt", "ge", "lt", "le") if (v := getattr(node, k, None)) is not None}
    words = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
    text = " and ".join(f"{words[k]} {_number(limits[k])}{unit}" for k in words if k in limits)
    return f"choose a value {text}" if text else "choose a value within the limit"


def _nested_metadata(annotation: Any) -> Iterator[Any]:
    """Yield the metadata of Annotated types inside an annotation."""
    yield from getattr(annotation, "__metadata__", ())
    for arg in get_args(annotation):
        yield from _nested_metadata(arg)


def _path(loc: tuple) -> str:
    """Format a path as `detector[1].axes_um`."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc)
    return text.removeprefix(".")


def _show(value: Any) -> str:
    """Format a value, shortened."""
    text = repr(list(value) if isinstance(value, tuple) else value)
    return text if len(text) <= 60 else text[:57] + "..."


def _number(value: Any) -> str:
    return f"{value:.15g}" if isinstance(value, float) else str(value)


def _first_sentence(text: str) -> str:
    """Return the first sentence or clause of a field's description."""
    return re.split(r"(?<=[.;])\s", " ".join(text.split()), maxsplit=1)[0].rstrip(".;")
