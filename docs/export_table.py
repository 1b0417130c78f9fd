"""Write the table of formats into docs/exports.md: `python docs/export_table.py`."""

import re
from pathlib import Path

from helio_jax.formats.export_formats import markdown_table

PAGE = Path(__file__).resolve().with_name("exports.md")
MARKS = r"(<!-- written by docs/export_table.py -->\n).*?(<!-- end -->)"


def with_table(text: str) -> str:
    """Return the page with the table as the program has it."""
    return re.sub(MARKS, lambda found: f"{found[1]}{markdown_table()}\n{found[2]}", text, flags=re.DOTALL)


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
