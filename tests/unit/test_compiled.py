"""Where compiled code is kept: the user's cache, unless he says otherwise or it cannot be written to."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from helio_jax.workflows.compilation_cache import keep_compiled

NAME = "JAX_COMPILATION_CACHE_DIR"


@pytest.fixture
def home(tmp_path, monkeypatch):
    """An empty home, and no variables of JAX; those that are set here are taken back."""
    for key in [NAME, "JAX_COMPILATION_CACHE_MAX_SIZE", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"]:
        monkeypatch.setenv(key, "")  # remembered, so that it is restored
        monkeypatch.delenv(key)
    monkeypatch.setattr("helio_jax.workflows.compilation_cache.user_cache_path", lambda name: tmp_path / name)
    return tmp_path


def test_one_folder_per_processor_and_the_users_own_choice_wins(home, monkeypatch):
    folder = keep_compiled()
    assert folder is not None and folder.is_relative_to(home / "helio_jax") and os.environ[NAME] == str(folder)
    monkeypatch.delenv(NAME)
    monkeypatch.setattr("helio_jax.workflows.compilation_cache._processor", lambda: "another")
    other = keep_compiled()
    assert other is not None and other != folder and other.parent == folder.parent
    monkeypatch.setenv(NAME, "")
    assert keep_compiled() is None and os.environ[NAME] == ""


def test_a_cache_that_cannot_be_made_is_done_without(home):
    (home / "helio_jax").write_text("a file where the folder should be")
    assert keep_compiled() is None and NAME not in os.environ


def test_a_second_process_compiles_nothing(home):
    """XLA's code is found again: no new entry. Rejects a cache key that depends on the process."""
    folder = keep_compiled()
    assert folder is not None
    program = (
        "import jax, jax.numpy as jnp\n"
        "jax.jit(lambda x: jnp.linalg.norm(jnp.fft.fft(jnp.sin(x)) @ x[:, None]) + jnp.sort(x).sum())(jnp.ones(64))\n"
    )
    env = os.environ | {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}

    def entries() -> set[Path]:
        subprocess.run([sys.executable, "-c", program], env=env, check=True)
        return {p for p in folder.iterdir() if p.name.endswith("-cache")}

    first = entries()
    assert first and entries() == first
