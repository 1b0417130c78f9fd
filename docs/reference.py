"""Reference pages made from the program: scene keys, commands, public names, files. `conf.py` inserts them.

A line `<!-- insert: NAME -->` of a page is replaced by what the function NAME returns, while the site is built. No
generated text is stored, so none can be stale.
"""

import inspect
from collections.abc import Iterator
from typing import Any

from typer.main import get_command

import helio_jax
from helio_jax.__main__ import app
from helio_jax.formats.nexus import RECONSTRUCTION_FIELDS, STACK_FIELDS, Field
from helio_jax.workflows.scene_file import json_schema

OWN = ("extends", "append", "name", "description")
"""Keys of a scene file that stand outside all tables."""
LIMITS = {"minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<"}
"""Words of a JSON schema, as a person writes them."""


def table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Format a Markdown table; cells are one line each."""
    cells = [[" ".join(str(cell).split()).replace("|", r"\|") for cell in row] for row in (head, *rows)]
    cells.insert(1, ["---"] * len(head))
    return "\n".join(f"| {' | '.join(row)} |" for row in cells)


def scene_keys() -> str:
    """List every key of a scene file by table and kind: values, default, meaning."""
    schema = json_schema()
    own = {name: schema["properties"][name] for name in OWN}
    parts = [f"## Outside all tables\n{_keys(own, schema.get('required', []))}"]
    parts += list(_tables(schema["properties"], schema["$defs"], "", 2, OWN))
    return "\n\n".join(parts)


def _tables(
    properties: dict, models: dict, above: str, level: int, without: tuple[str, ...] = (), seen: tuple[str, ...] = ()
) -> Iterator[str]:
    """Yield a section for each table among some keys, and for the tables within it."""
    for key, value in properties.items():
        names = [name for name in _models(value) if name not in seen]
        if key in without or not names:
            continue
        path = f"{above}.{key}" if above else key
        path += ".NAME" if "additionalProperties" in value else ""
        head = f"[[{path}]]" if _is_list(value) else f"[{path}]"
        if len(names) > 1:
            yield f"{'#' * level} {head}\n{value.get('description', '')}\n\nIts keys depend on `kind`."
        for name in names:
            model = models[name]
            kind = model["properties"].get("kind", {}).get("const")
            title = f'{head}, kind = "{kind}"' if len(names) > 1 else head
            depth = level + (len(names) > 1)
            text = _escape(model.get("description", ""))
            yield f"{'#' * depth} {title}\n{text}\n\n{_keys(model['properties'], model.get('required', []))}"
            yield from _tables(model["properties"], models, path, depth + 1, seen=(*seen, *names))


def _keys(properties: dict, required: list[str]) -> str:
    """Format the keys of one table."""
    rows = []
    for key, value in properties.items():
        default = "required" if key in required else _default(value)
        rows.append((f"`{key}`", _values(value), default, _escape(value.get("description", ""))))
    return table(("key", "values", "default", "meaning"), rows)


def _models(value: dict) -> list[str]:
    """Return the models of the tables that a key may hold."""
    if "$ref" in value:
        return [value["$ref"].removeprefix("#/$defs/")]
    inner = [*value.get("anyOf", ()), *value.get("oneOf", ())]
    inner += [part for word in ("items", "additionalProperties") if isinstance(part := value.get(word), dict)]
    return [name for part in inner for name in _models(part)]


def _is_list(value: dict) -> bool:
    """Whether a key holds a list."""
    return value.get("type") == "array" or any(_is_list(part) for part in value.get("anyOf", ()))


def _values(value: dict) -> str:
    """State in words what a key may hold."""
    if "const" in value:
        return f"`{value['const']}`"
    if "enum" in value:
        return ", ".join(f"`{word}`" for word in value["enum"])
    if _models(value):
        return "list of tables" if _is_list(value) else "table"
    if "anyOf" in value:
        return " or ".join(_values(part) for part in value["anyOf"] if part.get("type") != "null")
    if value.get("type") == "array":
        parts = value.get("prefixItems")
        if parts and all(part == parts[0] for part in parts):
            return f"{len(parts)} of: {_values(parts[0])}"
        return ", ".join(map(_values, parts)) if parts else f"list of: {_values(value.get('items', {}))}"
    limits = [f"{sign} {value[word]:g}" for word, sign in LIMITS.items() if word in value]
    word = {"integer": "whole number", "string": "text", "boolean": "`true`, `false`", "object": "table"}
    return " ".join((word.get(value.get("type", ""), value.get("type", "any")), ", ".join(limits))).strip()


def _default(value: dict) -> str:
    """Format the default of a key; that of a table is the defaults of its keys."""
    default = value.get("default")
    if default is None or default == "" or _models(value):
        return "none"
    return f"`{str(default).lower() if isinstance(default, bool) else default}`"


def _escape(text: str) -> str:
    """Escape what Markdown would read as markup outside of `code`."""
    parts = text.split("`")
    for i in range(0, len(parts), 2):
        parts[i] = "".join(f"\\{c}" if c in "*_<[" else c for c in parts[i])
    return "`".join(parts)


def commands() -> str:
    """List every command of `helio` with its arguments, options, defaults and meanings."""
    group: Any = get_command(app)
    return "\n\n".join(_command(name, command) for name, command in sorted(group.commands.items()))


def _command(name: str, command: Any) -> str:
    """Describe one command, in the words of its --help."""
    context = command.make_context(name, [], resilient_parsing=True)
    usage = " ".join(("helio", name, *command.collect_usage_pieces(context)))
    records = (param.get_help_record(context) for param in command.params)
    rows = [(f"`{names}`", _escape(meaning)) for names, meaning in records]
    parts = [f"## helio {name}", f"```text\n{usage}\n```", _escape(command.help or "")]
    return "\n\n".join([*parts, table(("argument or option", "meaning"), rows)])


def public_names() -> str:
    """Document every public name of the package, in alphabetical order."""
    parts = []
    for name in sorted(helio_jax.__all__, key=str.lower):
        value = getattr(helio_jax, name)
        kind = "class" if inspect.isclass(value) else "function" if callable(value) else "data"
        members = "   :members:\n" if kind == "class" else ""
        parts.append(f"## hx.{name}\n```{{eval-rst}}\n.. auto{kind}:: helio_jax.{name}\n{members}```")
    return "\n\n".join(parts)


def hdf5_fields() -> str:
    """List the arrays of a helio file: place below /entry, unit, meaning."""
    return "\n\n".join(
        f"### {title}\n{table(('place below /entry', 'attribute', 'unit', 'meaning'), _places(fields))}"
        for title, fields in (("Micrographs", STACK_FIELDS), ("Reconstruction", RECONSTRUCTION_FIELDS))
    )


def _places(fields: tuple[Field, ...]) -> list[tuple[str, ...]]:
    return [(f"`{f.place}`", f"`{f.name}`", f.unit, _escape(f.long_name)) for f in fields]
