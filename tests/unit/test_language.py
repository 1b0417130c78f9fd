"""Package, docs and README use the field's words (docs/glossary.md) and refer only to files of the repository."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
THIS = Path(__file__).resolve()
GLOSSARY = ROOT / "docs" / "glossary.md"
OLD_NAMES = {GLOSSARY, ROOT / "CHANGELOG.md"}
"""Pages that name the words to avoid."""
FOLDERS = ("helio_jax", "benchmarks", "tests", "docs", "scenes", "notebooks")
KINDS = {".py", ".md", ".toml", ".ipynb", ".sh", ".cff"}
FILES = sorted(p for folder in FOLDERS for p in (ROOT / folder).rglob("*") if p.suffix in KINDS and p != THIS)
PAGES = [*ROOT.glob("*.md"), *(p for p in FILES if p.suffix in (".md", ".ipynb")), ROOT / "CITATION.cff"]
PROSE = [p for p in PAGES if p not in OLD_NAMES]
PACKAGE = [p for p in FILES if p.is_relative_to(ROOT / "helio_jax")]
AVOIDED = {
    r"left to go": "convergence error",
    r"what is left( out)?": "residual, unmodelled signal",
    r"(un)?told|telling|is_told": "informative, determined",
    r"in doubt|doubtful": "poorly determined",
    r"torn|tears?|tearing": "depth jump, occlusion edge",
    r"Lagged": "frozen terms",
    r"adopt(s|ed)?": "set corrections",
    r"follow_modes": "finite-difference derivative",
    r"level ground|reference plane": "substrate",
    r"also off by|off_by_far|OFF_BY_FAR": "common-mode error",
    r"bent|widened|widening": "inflated by the Birge ratio",
    r"calm(er)?": "smoothed",
    r"retreating|retreats?": "backtracking",
    r"turned scans?": "rotated scans",
    r"shines?": "atoms, flux, signal",
    r"Crew|Keeper": "Executor, ScanResult, CheckpointedRun",
    r"it (says|tells|wants)": "states, determines, favours",
}
"""Words to avoid, as regular expressions of whole words, and the words of the glossary."""
ELSEWHERE = r"\b(DESIGN|DATA|STYLE|REVIEW|FINDINGS)(\.md|'s? section| section)|\bissue \d"
"""References to working notes that are not part of the repository."""


def found_in(files: list[Path], pattern: str, flags: int = 0) -> list[str]:
    """Return place and line of each match."""
    out = []
    for path in files:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
            if re.search(pattern, line, flags):
                out.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()[:100]}")
    return out


@pytest.mark.parametrize(
    "files",
    [PROSE, PACKAGE],
    ids=["docs", "package"],
)
@pytest.mark.parametrize("avoided", AVOIDED, ids=lambda avoided: AVOIDED[avoided])
def test_private_words_are_gone(files, avoided):
    """Catches words that a reader of the field would have to decode."""
    places = found_in(files, rf"\b({avoided})\b")
    assert not places, f"write {AVOIDED[avoided]!r} (docs/glossary.md):\n" + "\n".join(places)


def test_search_finds_words():
    """Catches a search that finds nothing, which would make all tests above pass."""
    assert len(FILES) > 200 and len(PACKAGE) > 100 and len(PROSE) > 8
    assert all(found_in([GLOSSARY], rf"\b({word})\b") for word in ("Crew", "left to go", "retreating"))


def test_nothing_refers_to_files_elsewhere():
    """Catches a reference that a reader of the repository cannot follow."""
    places = found_in([*FILES, *PROSE], ELSEWHERE)
    assert not places, "\n".join(places)
