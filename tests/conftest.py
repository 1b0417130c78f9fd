"""Shared fixtures of the tests."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder with data/ and reference/: HELIO_DATA, else ../shared beside the repository; skips without it."""
    root = Path(os.environ.get("HELIO_DATA") or Path(__file__).resolve().parents[2] / "shared")
    if not (root / "data").is_dir():
        pytest.skip(f"no measured data in {root}: set HELIO_DATA to the folder that holds data/ and reference/")
    return root


@pytest.fixture(scope="session")
def bshem():
    """The reference geometry: B-SHeM at 4 mm, sphere A's flat 4.72 mm below the plate."""
    from helio_jax.config import load_scene

    return load_scene(Path(__file__).resolve().parents[1] / "scenes" / "sphere_a.toml").instrument
