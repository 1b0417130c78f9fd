"""Where to spend the next second: `hx.next_scan`, `helio next`, the page docs/next.md."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import helio_jax as hx
import helio_jax.__main__
from helio_jax.commands.app import app
from helio_jax.errors import GuardError, SceneError
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings
from helio_jax.micrograph import ScanAlignment
from helio_jax.workflows import pipeline
from helio_jax.workflows.scene_file import load_scene

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "next.md").read_text(encoding="utf-8")
QUICK = ReconstructSettings(
    refine=RefineSettings(max_rounds=1, rays=20_000, photometric_rounds=1, objects=False, albedo_patches=False)
)
REGION = (-800.0, 800.0, -800.0, 800.0)
SECONDS = 30.0


def recorded(name: str, n: int = 11, **changes) -> hx.MicrographStack:
    """A small noisy scan of a shipped scene, one image per detector."""
    raster = {"scan.nx": n, "scan.ny": n, "scan.pixel_size_um": 30.0 * 121 / n, "noise.dwell_s": 0.1, "trace.rays": 16}
    scene = load_scene(name, raster | {"scan.atoms_per_pixel": 9000} | changes)
    found = pipeline.record(scene, pipeline.simulate(scene))
    return found.stacks[0]


@pytest.fixture(scope="module")
def first() -> hx.MicrographStack:
    return recorded("sphere_a")


@pytest.fixture(scope="module")
def found(first):
    return hx.next_scan(first, SECONDS, region_um=REGION, settings=QUICK)


def test_list_covers_the_time_on_the_raster(first, found, tmp_path):
    """Within the time, to 1 %; each position is a pixel, once, in scan order; the file is the list.

    Catches positions in another frame, lost or doubled blocks, and a list that takes longer than it may.
    """
    assert 0.99 * SECONDS <= found.dwell.sum() <= SECONDS and found.spent_s == pytest.approx(found.dwell.sum())
    column, row = (np.searchsorted(a, v) for a, v in zip((first.x, first.y), found.xy.T, strict=True))
    assert np.array_equal(first.x[column], found.xy[:, 0]) and np.array_equal(first.y[row], found.xy[:, 1])
    assert np.all(np.diff(row * first.x.size + column) > 0)
    assert np.array_equal(found.dwell_maps[0][row, column], found.dwell)
    found.write(tmp_path / "p.csv")
    table = np.genfromtxt(tmp_path / "p.csv", delimiter=",", names=True)
    assert table.dtype.names == ("rotation_deg", "x_um", "y_um", "dwell_s")
    assert np.allclose(table["x_um"], found.xy[:, 0]) and np.allclose(table["dwell_s"], found.dwell)
    assert np.all(table["rotation_deg"] == 0.0)


def test_it_is_expected_to_be_better_than_even_times(found):
    """For a third of the field: a lower standard deviation than the same time evenly, which is lower than so far.

    More time in the region than outside. Catches a sign, and a region that is not used.
    """
    assert found.proposed_um < 0.97 * found.even_um < found.now_um
    x, y = found.axes[0]
    inside = (np.abs(x) <= 800.0)[None, :] & (np.abs(y) <= 800.0)[:, None]
    dwell = found.dwell_maps[0]
    assert dwell[inside].mean() > 1.5 * dwell[~inside].mean()
    assert found.region_pixels + found.left_out == inside.sum()
    assert json.loads(json.dumps(found.as_dict()))["variance_ratio"] == pytest.approx(found.variance_ratio)


def test_the_next_list_knows_what_was_added(first, found):
    """Counts of the list are added: the standard deviation so far falls; it is still one scan of its orientation."""
    raw = np.array([[c[r, k] for r, k in _pixels(first, found)] for c in first.counts]) * found.dwell / 0.1
    both = hx.add_positions(first, found.xy, found.dwell, raw)
    again = hx.next_scan([both], SECONDS, region_um=REGION, settings=QUICK)
    assert again.now_um < 0.95 * found.now_um and len(again.shares) == 1
    assert both.dwell_times.sum() == pytest.approx(0.1 * 121 + found.dwell.sum())


def _pixels(stack, found) -> list[tuple[int, int]]:
    return [(int(np.searchsorted(stack.y, y)), int(np.searchsorted(stack.x, x))) for x, y in found.xy]


def test_rotations_are_chosen_from(first):
    """Normal incidence, three detectors on one side: other rotations get part of the time and are worth it.

    Catches images of a rotation that are those of the present one, which would be worth nothing more.
    """
    one = recorded("hybrid", **{"scan.rotations_deg": [0.0]})
    offered = hx.next_scan(one, SECONDS, rotations_deg=(90.0,), settings=QUICK, change_s=1.0)
    alone = hx.next_scan(one, SECONDS, settings=QUICK)
    assert [s.rotation_deg for s in offered.shares] == pytest.approx([0.0, 90.0])
    assert [s.is_present for s in offered.shares] == [True, False]
    assert offered.proposed_um < 1.02 * alone.proposed_um and offered.even_all_um is not None
    assert offered.spent_s <= SECONDS and offered.shares[1].positions > 0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"seconds": 0.0}, "time to spend must be a finite time > 0 s"),
        ({"move_s": -1.0}, "time to move must be a finite time >= 0 s"),
        ({"region_um": (5000.0, 6000.0, 0.0, 1.0)}, "must hold pixels of the height map"),
        ({"rotations_deg": (360.0,)}, "scanned already or given twice"),
        ({"rotations_deg": (90.0, 90.0)}, "scanned already or given twice"),
        ({"block": 50}, "block must be 1 to 11 pixels"),
    ],
)
def test_bad_questions_are_refused_before_the_fit(first, changes, said):
    """Catches an error that comes after minutes, or none."""
    with pytest.raises(SceneError, match=said):
        hx.next_scan(first, **({"seconds": 10.0} | changes))


def test_dwell_time_must_be_known(first):
    """Catches a time that is made up."""
    with pytest.raises(SceneError, match="dwell time that its counts belong to is not known"):
        hx.next_scan(first.replace(dwell=None), 10.0)


def test_few_counts_are_warned_of():
    """About 6 counts per pixel are known to 40 %. Catches a promise that simulated loops did not keep."""
    said: list[str] = []
    few = recorded("sphere_a", **{"scan.atoms_per_pixel": 500})
    hx.next_scan(few, SECONDS, region_um=REGION, settings=QUICK, say=said.append)
    assert any("known to" in text and "linear in the noise" in text for text in said)


def test_scans_without_noise_or_time_of_their_own_are_refused(first):
    """Catches a variance that is the tracer's, and dwell times of a mixture."""
    with pytest.raises(SceneError, match="no counting noise to reduce"):
        hx.next_scan(first.replace(noise="expected"), 10.0)
    with pytest.raises(SceneError, match="aligned or joined"):
        hx.next_scan(first.replace(alignment=ScanAlignment()), 10.0)


def test_images_that_give_no_heights_are_refused(first):
    """Two images, and a detector that was off. Catches a list from a fit of nothing."""
    nan = np.where(np.arange(3)[:, None, None] == 2, np.nan, first.counts)
    with pytest.raises(GuardError, match="heights need 3 or more images"):
        hx.next_scan(first.replace(counts=nan), SECONDS, settings=QUICK)
    counts = first.counts * np.array([1.0, 0.0, 1.0])[:, None, None]
    off = first.replace(counts=counts, variance=np.maximum(counts, 1.0), background=np.zeros(3))
    with pytest.raises(GuardError, match=f"detector '{first.instrument.detector_names[1]}' shows no signal"):
        hx.next_scan(off, SECONDS, settings=QUICK)


def test_page(tmp_path, monkeypatch):
    """The commands and the Python block of docs/next.md run as they stand there, on a smaller raster.

    Catches a renamed option, and a block that does not fit the commands.
    """
    monkeypatch.chdir(tmp_path)
    small = ["--rays", "16", "--no-picture"]
    for key, value in (("nx", 11), ("ny", 11), ("pixel_size_um", 330)):
        small += ["--set", f"scan.{key}={value}"]
    lines = [shlex.split(line, comments=True)[1:] for b in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
             for line in b.splitlines()]  # fmt: skip
    text = (
        (ROOT / "scenes" / "sphere_a.toml")
        .read_text(encoding="utf-8")
        .replace("instruments/bshem_wd4.toml", "bshem_wd4")
    )
    head = "[reconstruct.refine]\n"
    text = text.replace(head, head + "max_rounds = 1\nrays = 20000\nphotometric_rounds = 1\n")
    (tmp_path / "quick.toml").write_text(text)
    seen = []
    for words in lines:
        if words[0] not in ("simulate", "next") or "--rotations" in words or "--move" in words:
            continue
        words += ["--settings", "quick.toml"] if words[0] == "next" else small
        done = CliRunner().invoke(app, words, catch_exceptions=False)
        assert done.exit_code == 0, (words, done.output)
        seen.append(done.stdout)
    assert len(seen) == 2 and "variance over that of even times" in seen[1]
    assert (tmp_path / "positions.csv").is_file() and (tmp_path / "positions.png").stat().st_size > 5000
    (block,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    block = block.replace("600.0,", "60.0, settings=quick,")

    def measure(found):
        assert len(found.dwell)
        rate = hx.read("first.h5").counts.mean((1, 2)) / 0.1
        return rate[:, None] * found.dwell

    names: dict = {"measure": measure, "quick": QUICK}
    exec(compile(block, "docs/next.md", "exec"), names)
    assert names["both"].dwell_map.max() > 0.1
