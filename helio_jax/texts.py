"""TOML and JSON of untrusted files: nesting and whole numbers are limited, so that no text takes long or overflows.

tomllib takes quadratic time and memory for keys of many parts, Python refuses to print whole numbers of more than 4300
digits, and both parsers recurse. Every error is a ValueError without the name of the file, which the caller adds.
"""

import json
import re
import tomllib
from collections.abc import Callable
from typing import Any

MAX_DEPTH = 32
"""Deepest nesting of tables and lists, and most parts of a dotted key."""
MAX_KEYS = 10_000
"""Largest number of keys of a table."""
_PART = r"""(?:[\w-]++|(?<!\\)"(?:[^"\\\n]|\\[^\n])*+"|'[^'\n]*+')"""
_LONG_KEY = re.compile(rf"(?<![\w-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MAX_DEPTH}}}")


def parse_toml(text: str) -> dict[str, Any]:
    """Parse a TOML document.

    Raises:
        ValueError: not TOML, nested deeper than `MAX_DEPTH`, or a whole number of more than 64 bits.
    """
    if found := _LONG_KEY.search(text):
        line = text.count("\n", 0, found.start()) + 1
        raise ValueError(f"the key in line {line} has more than {MAX_DEPTH} parts: {found[0][:40]}...")
    return _parse(tomllib.loads, text)


def parse_value(text: str) -> Any:
    """Parse a value as in TOML; anything else is a text."""
    try:
        return parse_toml(f"value = {text}")["value"]
    except ValueError:
        return text


def parse_json(text: str | bytes) -> Any:
    """Parse a JSON document.

    Raises:
        ValueError: not JSON, nested deeper than `MAX_DEPTH`, or a whole number of more than 64 bits.
    """
    return _parse(json.loads, text)


def _parse(loads: Callable[[Any], Any], text: str | bytes) -> Any:
    """Parse a text and check the limits."""
    try:
        return _checked(loads(text))
    except RecursionError:
        raise ValueError(f"lists or tables are nested deeper than {MAX_DEPTH}") from None
    except ValueError as e:
        if "integer string conversion" in str(e):  # Python's own limit, 4300 digits
            raise ValueError("a whole number has more than 64 bits: write fewer digits") from None
        raise


def _checked(tree: Any) -> Any:
    """Return a tree of tables and lists whose depth and whole numbers are within the limits."""
    level = [tree]
    for _ in range(MAX_DEPTH + 1):
        for value in level:
            if isinstance(value, int) and not -(2**63) <= value < 2**64:
                raise ValueError(f"a whole number of {value.bit_length()} bits, the limit is 64: write fewer digits")
            if isinstance(value, dict) and len(value) > MAX_KEYS:
                raise ValueError(f"a table of {len(value)} keys, the limit is {MAX_KEYS}")
        tables = [v.values() if isinstance(v, dict) else v for v in level if isinstance(v, (dict, list))]
        level = [child for table in tables for child in table]
        if not level:
            return tree
    raise ValueError(f"lists or tables are nested deeper than {MAX_DEPTH}")
