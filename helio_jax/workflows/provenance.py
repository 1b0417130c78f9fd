"""Provenance of simulated micrographs: everything needed to reproduce them, stored in their file."""

import os
import platform
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

from helio_jax.micrograph import Micrographs
from helio_jax.trace.job import package_version
from helio_jax.workflows.scene_file import SceneFile, resolved


def with_provenance(
    stack: Micrographs, scene: SceneFile, scene_path: str | Path, scene_text: str | None = None
) -> Micrographs:
    """Add scene text, resolved scene, versions, commit, machine, command line and time to the provenance.

    Args:
        stack: simulated micrographs.
        scene: their scene.
        scene_path: its file; only its name counts where `scene_text` is given.
        scene_text: text of that file.
    """
    path = Path(scene_path)
    names = ("helio-jax", "numpy", "numba", "embreex", "jax", "optimistix", "trimesh")
    about = {
        "scene_file": path.name,
        "scene_text": path.read_text(encoding="utf-8") if scene_text is None else scene_text,
        "scene": resolved(scene),
        "versions": {name: package_version(name) for name in names},
        "git": git_commit(),
        "machine": {"processor": platform.machine(), "system": platform.system(), "cpus": os.cpu_count()},
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
    return replace(stack, provenance={**stack.provenance, **about})


def git_commit() -> str:
    """Return the git commit of this package's checkout, or "" outside a checkout."""
    checkout = Path(__file__).resolve().parents[2]
    if not (checkout / ".git").exists():  # installed: a repository further up is another project's
        return ""
    command = ["git", "-C", str(checkout), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=False).stdout.strip()
    except (OSError, subprocess.TimeoutExpired):
        return ""
