"""Shared fixtures of the tests."""

import gc
import os
import shutil
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

import pytest

FAST = {
    "formats": ("export", "export_formats", "hdf5", "matlab"),
    "inverse": ("edges", "integrate"),
    "physics": ("formfactor", "render", "tracer"),
    "unit": (
        *("align", "arrays", "away_facets", "calibrate", "conventions", "edge_rule", "figures", "instrument"),
        *(
            "instrument_file",
            "language",
            "materials",
            "measure",
            "merge",
            "metrics",
            "placement",
            "project_files",
            "report",
        ),
        *("response", "sample", "scans", "scene", "settings", "shipped", "units", "walls", "widening"),
    ),
}
"""Modules tests/FOLDER/test_NAME.py whose tests, but for slow ones, are marked `fast`; so is test_architecture.py."""
LONG = {
    "inverse/test_cut_mesa.py": "",
    "inverse/test_discrepancy.py": "test_error_bars_hold_where_the_model_lacks_something",
    "inverse/test_error_bars.py": "test_errors_reach_the_cramer_rao_bound",
    "inverse/test_floating_step.py": "",
    "inverse/test_hollow_pyramid.py": "",
    "inverse/test_law_in_the_fit.py": "test_traced_rough_surface",
    "inverse/test_low_steps.py": (
        "test_a_step_that_only_dashes_show_is_measured",
        "test_a_bright_line_is_no_step",
        "test_a_high_step_that_faces_away_is_not_measured_by_its_glow",
    ),
    "inverse/test_mask_bands.py": "test_round_outlines_have_right_heights",
    "inverse/test_objects.py": "test_a_ball_with_vertical_sides_is_as_high_as_it_is",
    "inverse/test_rims.py": "test_height_of_a_traced_dome",
    "inverse/test_wrong_background.py": "test_the_height_is_right_and_the_offsets_are_named",
    "unit/test_comparison.py": "test_explain_names_the_effect",
    "unit/test_conventions.py": "test_two_images_do_where_the_albedo_is_known",
    "unit/test_known_shape.py": "",
    "unit/test_mask_directions.py": "",
}
"""Tests that take a minute or more on one core, by module and names ("": all of the module). They are marked `long`
and left out unless asked for: `pytest -m long`, before a change of what they test and before a release."""
QUICK_XLA = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
"""XLA's plain code generator, without optimisation: it compiles five times faster. The same programs to rounding, which
tests/inverse/test_frozen.py pins; one test there and the notebooks of the site run what users run. `XLA_FLAGS= pytest`:
all tests do."""
_QUICK_JAXLIB = "0.10."
"""Where these flags are known to exist: XLA ends a process that names an unknown one."""
MOST_MAPS = 15_000
"""Memory maps of a process above which JAX's compiled programs are dropped. A fit adds up to 2000; Linux allows 65 530
and ends a process that asks for more, as it did to one that had run half of the suite."""
_CACHE = "JAX_COMPILATION_CACHE_DIR"
_OWN = pytest.StashKey[str]()


def pytest_configure(config: pytest.Config) -> None:
    """Compile quickly, and let all processes of this run share what JAX compiles: most of the time of a small fit.

    Linear algebra takes one thread in each of several processes: waiting threads cost them a tenth of their time. It is
    set before they start, for NumPy reads it when it is imported.
    """
    if getattr(config.option, "numprocesses", None):
        os.environ.setdefault("OMP_NUM_THREADS", "1")
    if version("jaxlib").startswith(_QUICK_JAXLIB):
        os.environ.setdefault("XLA_FLAGS", QUICK_XLA)
    if _CACHE not in os.environ:
        config.stash[_OWN] = os.environ[_CACHE] = tempfile.mkdtemp(prefix="helio-jax-tests-")
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.02"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what `pytest -m fast` runs, modules of every stage, about 80 s of CPU time in all; and what is `LONG`."""
    fast = {f"{folder}/test_{name}.py" for folder, names in FAST.items() for name in names}
    for item in items:
        place = item.path.relative_to(Path(__file__).parent).as_posix()
        if place in LONG and item.name.startswith(LONG[place]):
            item.add_marker(pytest.mark.long)
        elif (place in fast or place == "test_architecture.py") and not item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.fast)


def pytest_unconfigure(config: pytest.Config) -> None:
    """Remove it."""
    if _OWN in config.stash:
        shutil.rmtree(config.stash[_OWN], ignore_errors=True)


@pytest.fixture(autouse=True, scope="module")
def _few_memory_maps():
    """Drop compiled programs after a module when there are many."""
    yield
    maps = Path("/proc/self/maps")
    if "jax" in sys.modules and maps.exists() and maps.read_bytes().count(b"\n") > MOST_MAPS:
        sys.modules["jax"].clear_caches()
        gc.collect()


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
    from helio_jax.workflows.scene_file import load_scene

    return load_scene(Path(__file__).resolve().parents[1] / "scenes" / "sphere_a.toml").instrument
