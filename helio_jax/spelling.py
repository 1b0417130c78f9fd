"""Near matches of a misspelt name, for messages."""

import difflib
import re
from collections.abc import Iterable

_UNIT = re.compile(r"_(nm|um|mm|cm|m|inch|deg|rad|mrad|mev|mb|s)$")


def did_you_mean(word: str, known: Iterable[str], nearness: float = 0.6, most: int = 1) -> str | None:
    """Return the question for the known names that are nearest to a word; None: none is near.

    Units at the ends of names do not count as likeness.

    Args:
        word: what was written.
        known: names that would be right.
        nearness: least similarity of two names, from 0 (nothing in common) to 1 (equal).
        most: largest number of names in the question.
    """
    whole = {_UNIT.sub("", name): name for name in known}
    near = [repr(whole[name]) for name in difflib.get_close_matches(_UNIT.sub("", word), whole, most, nearness)]
    return f"did you mean {' or '.join(near)}?" if near else None
