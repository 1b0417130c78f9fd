"""Every notebook runs in its fast mode and is stored without outputs."""

from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))


def test_there_are_notebooks():
    """Catches a glob that finds nothing."""
    assert NOTEBOOKS


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_notebook(path, monkeypatch, request):
    """Runs top to bottom with HELIO_FAST=1; catches an API that moved on and stored outputs.

    Notebooks on measured data (metadata `helio.needs`) are skipped where there is none, rather than download it.
    """
    nbformat = pytest.importorskip("nbformat")
    nbclient = pytest.importorskip("nbclient")
    book = nbformat.read(path, as_version=4)
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in book.cells)
    if "needs" in book.metadata.get("helio", {}):
        monkeypatch.setenv("HELIO_DATA", str(request.getfixturevalue("shared")))
    monkeypatch.setenv("HELIO_FAST", "1")
    nbclient.NotebookClient(
        book, timeout=300, kernel_name="python3", resources={"metadata": {"path": FOLDER}}
    ).execute()
