"""Every benchmark script runs at tiny size, so that none can rot."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = [p for p in sorted((ROOT / "benchmarks").glob("*.py")) if "--tiny" in p.read_text()]


def test_there_are_benchmarks():
    """Catches a glob that finds nothing, which would make the next test pass on nothing."""
    assert SCRIPTS


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: p.stem)
def test_runs_at_tiny_size(script, tmp_path):
    """Exit code 0 and a JSON with rows, versions and seed."""
    command = [sys.executable, str(script), "--tiny", "--output", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1200, check=False)
    assert done.returncode == 0, done.stderr
    result = json.loads(next(tmp_path.glob("*.json")).read_text())
    assert result["rows"] and result["versions"] and "seed" in result
