"""Provenance: what is needed to reproduce simulated micrographs and height maps, stored in their file."""

import functools
import os
import platform
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from helio_jax.micrograph import Micrographs
from helio_jax.trace.job import package_version
from helio_jax.workflows.scene_file import SceneFile, resolved


def with_provenance(
    stack: Micrographs, scene: SceneFile, scene_path: str | Path, scene_text: str | None = None
) -> Micrographs:
    """Add scene text, resolved scene and `this_run` to the provenance.

    Args:
        stack: simulated micrographs.
        scene: their scene.
        scene_path: its file; only its name counts where `scene_text` is given.
        scene_text: text of that file.
    """
    path = Path(scene_path)
    text = path.read_text(encoding="utf-8") if scene_text is None else scene_text
    about = {"scene_file": path.name, "scene_text": text, "scene": resolved(scene)}
    return replace(stack, provenance={**stack.provenance, **about, **this_run()})


def this_run() -> dict[str, Any]:
    """Return versions, commit, machine, command line and time."""
    names = ("helio-jax", "numpy", "numba", "embreex", "jax", "optimistix", "trimesh")
    return {
        "versions": {name: package_version(name) for name in names},
        "git": git_commit(),
        "machine": {"processor": platform.machine(), "system": platform.system(), "cpus": os.cpu_count()},
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }


def git_commit() -> str:
    """Return the git commit of this package's checkout, or "" outside a checkout."""
    return _commit_of(Path(__file__).resolve().parents[2])


@functools.cache
def _commit_of(checkout: Path) -> str:
    """Return the git commit of a checkout, or ""; asked for once, for every simulation states it."""
    if not (checkout / ".git").exists():  # installed: a repository further up is another project's
        return ""
    command = ["git", "-C", str(checkout), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=False).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        return ""
