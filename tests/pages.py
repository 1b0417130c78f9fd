"""Runs a page of the docs as a reader would: its blocks in their order, in one folder.

A `toml` block whose first line is `# NAME.toml` is saved under that name. A `python` block runs; the blocks of a page
share their names. A `sh` block of `helio` commands runs in this process, any other one in a shell.
"""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from helio_jax.__main__ import main

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def blocks(text: str) -> list[tuple[str, str]]:
    """Return language and code of every block of a page."""
    return BLOCK.findall(text)


def run_page(text: str, folder: Path, monkeypatch: pytest.MonkeyPatch, small: Mapping[str, str]) -> dict:
    """Run a page in a folder; each file that a command names by `-o` must be there in the end.

    Args:
        text: the page.
        folder: where it runs.
        monkeypatch: of the test.
        small: replacements in scene files before a command reads them, so that it takes less time.

    Returns:
        The names of its Python blocks.
    """
    monkeypatch.chdir(folder)
    names: dict = {}
    for language, code in blocks(text):
        if language == "toml" and (name := re.match(r"# (\w+\.toml)\n", code)):
            (folder / name[1]).write_text(code, encoding="utf-8")
        elif language == "python":
            exec(compile(code, "page", "exec"), names)
        elif language == "sh" and all(line.startswith("helio ") for line in code.splitlines()):
            for line in code.splitlines():
                shrink(folder, small)
                run_helio(line)
        elif language == "sh":
            run_shell(code, folder)
    outputs = re.findall(r"^helio .*? -o (\S+)", text, re.MULTILINE)
    assert not (missing := [file for file in outputs if not (folder / file).exists()]), missing
    return names


def shrink(folder: Path, small: Mapping[str, str]) -> None:
    """Make the scenes of a folder small."""
    for file in folder.glob("*.toml"):
        text = file.read_text(encoding="utf-8")
        for before, after in small.items():
            text = re.sub(rf"^{re.escape(before)}(?=\s|$)", after, text, flags=re.MULTILINE)
        file.write_text(text, encoding="utf-8")


def run_helio(line: str) -> None:
    """Run one command; it must end with exit code 0."""
    words = shlex.split(line, comments=True)
    with pytest.raises(SystemExit) as end:
        main(words[1:])
    assert not end.value.code, line


def run_shell(code: str, folder: Path) -> None:
    """Run a block in a shell that finds `helio`, and SLURM's `sbatch` and `srun` as they work on one machine."""
    python = f'exec "{sys.executable}" -m helio_jax "$@"'
    task = "SLURM_ARRAY_TASK_ID=$i SLURM_ARRAY_TASK_MAX=$n SLURM_CPUS_PER_TASK=1"
    slurm = f'n="${{1##*-}}"; shift; for i in $(seq "$n"); do {task} bash "$@"; done'
    for place, script in {"helio": python, ".venv/bin/helio": python, "sbatch": slurm, "srun": 'exec "$@"'}.items():
        path = folder / ("" if "/" in place else "bin") / place
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"#!/bin/bash\n{script}\n", encoding="utf-8")
        path.chmod(0o755)
    env = os.environ | {"PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(["bash", "-e", "-c", code], cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
