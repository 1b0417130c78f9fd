"""Every benchmark script runs at tiny size, so that none can rot.

They run in the tests' own process, where what one has compiled serves the next, and the libraries are loaded once.
"""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

from helio_jax.inverse import settings

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = [p for p in sorted((ROOT / "benchmarks").glob("*.py")) if "--tiny" in p.read_text()]
FEW_PATHS = 100_000
"""Paths per prediction of multiple scattering: most of the time would go into the three million of a real fit."""
QUICKEST = ROOT / "benchmarks" / "outline.py"


def check_result(folder: Path) -> None:
    """Check the JSON of a run: rows, versions and seed."""
    result = json.loads(next(folder.glob("*.json")).read_text())
    assert result["rows"] and result["versions"] and "seed" in result


def test_there_are_benchmarks():
    """Catches a glob that finds nothing, which would make the next test pass on nothing."""
    assert QUICKEST in SCRIPTS and len(SCRIPTS) > 10


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.stem)
def test_runs_at_tiny_size(script, tmp_path, monkeypatch):
    """No error and a JSON with rows, versions and seed; the script calls its `main` where it is run as one.

    Catches a name, an option or a record that has moved on.
    """
    assert script.read_text().rstrip().endswith('if __name__ == "__main__":\n    main()')
    monkeypatch.syspath_prepend(str(ROOT))
    monkeypatch.setattr(settings, "LEAST_PATHS", FEW_PATHS)
    monkeypatch.setattr(sys, "argv", [str(script), "--tiny", "--output", str(tmp_path)])
    importlib.import_module(f"benchmarks.{script.stem}").main()
    check_result(tmp_path)


def test_runs_as_a_script(tmp_path):
    """Exit code 0 from another folder, without help from the tests' paths. Catches a script that cannot be run."""
    command = [sys.executable, str(QUICKEST), "--tiny", "--output", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    check_result(tmp_path / "out")
