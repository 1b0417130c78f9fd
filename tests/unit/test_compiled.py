"""Where compiled code is kept: the user's cache, unless he says otherwise or it cannot be written to.

And that it can be: JAX keeps no program that calls the host.
"""

import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest

import helio_jax as hx
from helio_jax.forward import masking, render
from helio_jax.inverse import responses, state
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


def test_the_programs_of_masks_do_not_call_the_host(bshem, monkeypatch):
    """JAX keeps no program that does: each process would compile it again, the derivatives of masks for 6 s.

    That the search does show where it is seen: masks whose horizons nobody chose before.
    """
    shape = 5, 6
    optics, raster = hx.Optics.of(bshem), hx.Raster.regular(shape, 40.0)
    surface = hx.Surface(np.random.default_rng(0).random(shape), *np.zeros((2, *shape)))
    programs = []

    def spied(module, name):
        function = getattr(module, name)

        def spy(*args):
            arrays, rest = eqx.partition(args, eqx.is_array)
            programs.append(str(jax.make_jaxpr(lambda a: function(*eqx.combine(a, rest)))(arrays)))
            return function(*args)

        monkeypatch.setattr(module, name, spy)

    for module, name in [
        (render, "_rendered"),
        (render, "_jitted_corrections"),
        (responses, "_masked_change_by"),
        (state, "_masked_moves"),
    ]:
        spied(module, name)
    hx.render(surface, optics, raster)
    render.masking_corrections(surface, optics, raster)
    with jax.enable_x64(True):
        responses._masked_change(surface, surface, optics, raster, None)
        state.masked_moves(surface, optics, raster, np.zeros((3, optics.n_detectors)))
        assert "callback" in str(
            jax.make_jaxpr(
                lambda h: masking.masked_form_factor(hx.Surface(h, surface.slope_x, surface.slope_y), optics, raster)
            )(surface.height)
        )
    assert len(programs) == 4 and not any("callback" in program for program in programs)
