"""Where micrographs come from: what is needed to make them again, as their file keeps it."""

import os
import platform
import subprocess
import sys
import time
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from helio_jax.micrograph import Micrographs
from helio_jax.workflows.scene_file import SceneFile, resolved


def with_provenance(stack: Micrographs, scene: SceneFile, scene_path: str | Path) -> Micrographs:
    """Return the micrographs with what is needed to make it again: scene text, versions, commit, command line, time."""
    path = Path(scene_path)
    names = ("helio-jax", "numpy", "numba", "embreex", "jax", "optimistix", "trimesh")
    about = {
        "scene_file": path.name,
        "scene_text": path.read_text(encoding="utf-8"),
        "scene": resolved(scene),
        "versions": {name: package_version(name) for name in names},
        "git": git_commit(),
        "machine": {"processor": platform.machine(), "system": platform.system(), "cpus": os.cpu_count()},
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    return replace(stack, provenance={**stack.provenance, **about})


def package_version(name: str) -> str:
    """Return the version of an installed package."""
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def git_commit() -> str:
    """Return the commit of the checkout that this package runs from, or "" outside one."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=False).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        return ""
