"""Near matches of a misspelt name, for messages."""

import difflib
import re
from collections.abc import Iterable

_UNIT = re.compile(r"_(nm|um|mm|cm|m|inch|deg|rad|mrad|mev|mb|s)$")
NEARNESS = 0.6
"""Least similarity of two names, from 0 (nothing in common) to 1 (equal)."""


def near_name(word: str, known: Iterable[str], nearness: float = NEARNESS) -> str | None:
    """Return the known name that is nearest to a word, or None; units at their ends do not count as likeness."""
    whole = {_UNIT.sub("", name): name for name in known}
    found = difflib.get_close_matches(_UNIT.sub("", word), whole, 1, nearness)
    return whole[found[0]] if found else None


def did_you_mean(word: str, known: Iterable[str], nearness: float = NEARNESS) -> str | None:
    """Return the question for the known name that is nearest to a word, or None."""
    name = near_name(word, known, nearness)
    return None if name is None else f"did you mean {name!r}?"
