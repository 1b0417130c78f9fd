"""Orientation of arrays and order of images: turning, symmetries, the search, its ties and refusals."""

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest

from helio_jax import import_micrographs, read, write
from helio_jax.__main__ import main
from helio_jax.alignment.orientation import (
    ALL_TURNS,
    Candidate,
    Turn,
    bin_stack,
    group_ties,
    instrument_symmetries,
    orders_tried,
    turn_stack,
)
from helio_jax.errors import GuardError, InputFileError, SceneError
from helio_jax.forward.form_factor import form_factor, substrate_signal
from helio_jax.forward.optics import Optics
from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.inverse.consistency import misfit
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.micrograph import Calibration, MicrographStack, ScanAlignment
from helio_jax.scene.scan import Raster
from helio_jax.workflows import pipeline
from helio_jax.workflows.orient import Entry, OrientSettings, Ranking, find_orientation
from helio_jax.workflows.scene_file import load_instrument, load_scene

SCENES = Path(__file__).resolve().parents[2] / "scenes"
QUICK = ReconstructSettings(method="nearfield", integrator="dct_poisson", rounds=3)


def ring(*azimuths, incidence=0.0, polar=35.0, **other) -> Instrument:
    """Return an instrument with round cones at these azimuths [deg]; `other`: polar angles of single ones."""
    cones = [
        Detector(name=f"d{k}", polar_deg=other.get(f"d{k}", polar), azimuth_deg=a, half_angle_deg=8.0)
        for k, a in enumerate(azimuths)
    ]
    return Instrument(
        beam=Beam(incidence_deg=incidence), plate=Plate(working_distance_um=3000.0), detector=tuple(cones)
    )


def simulated(n_x=42, n_y=34, scene="two_spheres", **overrides) -> MicrographStack:
    """Return traced micrographs with counting noise on a raster of unlike sides."""
    whole = load_scene(SCENES / f"{scene}.toml").scan
    assert isinstance(whole, Raster)
    step = whole.pixel_size_um * whole.nx / n_x
    changed = {"scan.nx": n_x, "scan.ny": n_y, "scan.pixel_size_um": step, **overrides}
    loaded = load_scene(SCENES / f"{scene}.toml", changed)
    stack = pipeline.record(loaded, pipeline.simulate(loaded, rays=64))
    assert isinstance(stack, MicrographStack) and stack.noise == "poisson"
    return stack


@pytest.fixture(scope="module")
def spheres() -> MicrographStack:
    """Two unlike spheres, B-SHeM."""
    return simulated()


def plain(instrument, counts, n_rays=1.0, variance=1.0) -> MicrographStack:
    x, y = (20.0 * np.arange(n) - 130.0 for n in counts.shape[:0:-1])
    about = {"variance": np.full(counts.shape, variance), "n_rays": n_rays, "noise": "poisson"}
    return MicrographStack(counts, x, y, instrument, **about)


@pytest.mark.parametrize("turn", ALL_TURNS, ids=str)
def test_turned_images_show_the_turned_positions(turn):
    """Closed form: what was at (x, y) is at M (x, y), M = turn after mirror, on an off-centre raster of unlike sides.

    Catches a turn of the other sense (rows go up, so `rot90` turns the other way), the mirror after the turn instead
    of before, axes that are not reversed, and a fast axis that stays.
    """
    f = lambda x, y: 3.0 * x + 5.0 * y + 0.01 * x * y  # noqa: E731
    stack = plain(ring(0, 120, 240), np.zeros((3, 5, 7)))
    x, y = np.meshgrid(stack.x, stack.y)
    stack = stack.replace(counts=np.stack([f(x, y), 2.0 * f(x, y), -f(x, y)]), background=np.array([1.0, 2.0, 3.0]))
    turned = turn_stack(stack, turn, (2, 0, 1))
    c, s = math.cos(math.radians(turn.turn_deg)), math.sin(math.radians(turn.turn_deg))
    x, y = np.meshgrid(turned.x, turned.y)
    before_x, before_y = c * x + s * y, -s * x + c * y
    expected = f(-before_x if turn.mirror else before_x, before_y)
    np.testing.assert_allclose(turned.counts, np.stack([-expected, expected, 2.0 * expected]), atol=1e-9)
    assert turned.background is not None and turned.background.tolist() == [3.0, 1.0, 2.0]
    assert turned.fast_axis == ("y" if turn.turn_deg in (90, 270) else "x")


def test_turns_are_a_group():
    """Closed under composition, and images follow matrices. Catches `after` with its arguments exchanged."""
    image = np.arange(12.0).reshape(3, 4)
    for a, b in itertools.product(ALL_TURNS, repeat=2):
        np.testing.assert_array_equal(a.after(b).image(image), a.image(b.image(image)))
    assert len({t.image(image).tobytes() + bytes(t.image(image).shape) for t in ALL_TURNS}) == 8


def test_binning_keeps_the_mean_and_its_variance():
    """Squares of 3 x 3: mean, variance / 9, axis in the middle; a lost pixel leaves the mean of the other eight.

    Catches the variance of a sum taken for that of a mean, unobserved pixels counted as 0, shifted axes.
    """
    rng = np.random.default_rng(4)
    counts = rng.normal(100.0, 1.0, (3, 20, 30))
    counts[1, 4, 4] = np.nan
    small = bin_stack(plain(ring(0, 120, 240), counts), 12)
    assert small.shape == (3, 6, 10)
    np.testing.assert_allclose(small.counts[0, 1, 2], counts[0, 3:6, 6:9].mean())
    np.testing.assert_allclose(small.counts[1, 1, 1], np.nanmean(counts[1, 3:6, 3:6]))
    assert small.variance is not None
    np.testing.assert_allclose(small.variance[0], 1.0 / 9.0)
    np.testing.assert_allclose(small.variance[1, 1, 1], 1.0 / 8.0)
    assert small.x[0] == -110.0 and small.x[1] - small.x[0] == 60.0


@pytest.mark.parametrize(
    ("instrument", "n"),
    [
        (ring(0, 90, 180, 270), 8),
        (ring(0, 120, 240), 2),
        (ring(0, 120, 240, incidence=30.0), 2),
        (ring(90, 210, 330, incidence=30.0), 1),
        (ring(0, 90, 180, 270, incidence=30.0), 2),
        (ring(0, 90, 180, 270, d1=45.0), 2),
        (ring(0, 90, 180, 270, d1=40.0, d2=45.0), 1),
        (ring(0, 180, 90), 2),
    ],
)
def test_symmetries_of_instruments(instrument, n):
    """Counted by hand: a square 8, three at 120 deg 2, oblique incidence leaves only mirrors along the beam.

    Catches a beam that is left out, and polar angles that do not count.
    """
    found = instrument_symmetries(instrument)
    assert len(found) == n and found[0] == (Turn(), tuple(range(len(instrument.detector))))


def test_ties_of_the_square_are_turned_detectors():
    """A turn of the square by 90 deg carries detector 0 to detector 1. Catches the inverse permutation."""
    square = ring(0, 90, 180, 270)
    groups = group_ties([Candidate(t, o) for t in ALL_TURNS for o in orders_tried(square)[0]], square)
    assert len(groups) == 24 and all(len(ties) == 8 for ties in groups)
    first = next(ties for ties in groups if Candidate(Turn(), (0, 1, 2, 3)) in ties)
    assert Candidate(Turn(90), (3, 0, 1, 2)) in first  # the image of detector 0 now belongs to detector 1


def test_ties_cost_the_same(spheres):
    """No fit prefers one of two ties, and any other pair differs: the symmetry is one of the data, too.

    Catches ties of the wrong permutation or orientation, which cost several per cent more or less.
    """
    candidates = [Candidate(t, o) for t in ALL_TURNS for o in orders_tried(spheres.instrument)[0]]
    optics = Optics.of(spheres.instrument)
    cost = lambda c: misfit(turn_stack(spheres, c.turn, c.order), optics, QUICK)  # noqa: E731
    groups = group_ties(candidates, spheres.instrument)
    assert len(groups) == 24
    costs = [[cost(c) for c in ties] for ties in groups[:6]]
    np.testing.assert_allclose([b for _, b in costs], [a for a, _ in costs], rtol=1e-6)
    assert np.diff(np.sort([a for a, _ in costs])).min() > 1e-4


def shuffled(stack: MicrographStack, turn: Turn, order: tuple[int, ...]) -> tuple[MicrographStack, Candidate]:
    """Return a stack as a file might hold it, and the candidate that puts it right."""
    back = next(t for t in ALL_TURNS if t.after(turn) == Turn())
    return turn_stack(stack, turn, order), Candidate(back, tuple(int(i) for i in np.argsort(order)))


@pytest.mark.parametrize(
    ("turn", "order"),
    list(zip(ALL_TURNS, [*itertools.permutations(range(3)), (1, 2, 0), (2, 0, 1)], strict=True)),
    ids=str,
)
def test_every_orientation_is_found_again(spheres, turn, order):
    """Two spheres, shuffled: the ties that win are the truth and its mirror image; with the handedness given, the
    counts come back to the bit.

    Catches a search that leaves out an orientation, an order applied the wrong way round, and a fit without masks and
    multiple scattering, which takes these spheres for hollows.
    """
    stack, truth = shuffled(spheres, turn, order)
    found = find_orientation(stack, OrientSettings(finalists=2))
    assert truth in found.entries[0].ties and len(found.entries[0].ties) == 2
    assert {c.turn.mirror for c in found.entries[0].ties} == {False, True} and found.margin > 0.2
    with pytest.raises(GuardError, match=r"its own mirror image.*--mirror or --no-mirror"):
        found.applied()
    known = find_orientation(stack, OrientSettings(finalists=2, mirror=truth.turn.mirror)).applied()
    np.testing.assert_array_equal(known.counts, spheres.counts)
    np.testing.assert_allclose(known.x, spheres.x)
    assert known.provenance["orient"]["turn_deg"] == truth.turn.turn_deg


def test_winner_without_ties():
    """Detectors that are no mirror image of themselves: one winner, written without being told the handedness.

    Catches ties that are none.
    """
    cones = [d.model_dump(exclude_none=True) for d in ring(20, 120, 250, d1=42.0).detector]
    stack, truth = shuffled(simulated(detector=cones), Turn(90, True), (1, 2, 0))
    found = find_orientation(stack, OrientSettings(finalists=2))
    assert found.entries[0].ties == (truth,) and found.problems == ()
    assert turn_stack(stack, truth.turn, truth.order).counts.tolist() == found.applied().counts.tolist()


def test_measured_scan_with_gains_and_backgrounds_of_its_own():
    """Sphere A with unlike gains and backgrounds, as measured: the calibration follows the images to their detectors.

    Catches a flat signal that stays with the image when that goes to another detector.
    """
    sphere = simulated(48, 48, "sphere_a")
    gain, dark = np.array([1.0, 2.2, 0.6])[:, None, None], np.array([900.0, 300.0, 2000.0])[:, None, None]
    assert sphere.variance is not None
    raw = sphere.replace(
        counts=gain * sphere.counts + dark, variance=gain**2 * sphere.variance, n_rays=None, noise="measured"
    )
    stack, truth = shuffled(raw, Turn(270), (2, 1, 0))
    found = find_orientation(stack, OrientSettings(finalists=2, mirror=truth.turn.mirror))
    assert found.winner == truth
    np.testing.assert_array_equal(found.applied().counts, raw.counts)


def test_flat_is_refused(spheres):
    """Counts of a flat with Poisson noise tell nothing; the message names margin, limit and remedy.

    The limit is 5 standard deviations of the cost's own scatter (2 / degrees of freedom), or 20 %. Catches a winner by
    chance.
    """
    flat = spheres.n_rays * substrate_signal(Optics.of(spheres.instrument))[:, None]
    counts = np.random.default_rng(11).poisson(np.broadcast_to(flat[:, :, None], spheres.shape)).astype(float)
    stack = plain(spheres.instrument, counts, spheres.n_rays).replace(variance=np.maximum(counts, 1.0))
    found = find_orientation(stack, OrientSettings(finalists=2, mirror=False))
    assert found.margin < 0.1 < found.limit
    with pytest.raises(GuardError, match=r"the limit is \d+%.*--detectors"):
        found.applied()


def test_margin_counts_every_rival(spheres):
    """By hand: the closest of a finalist, of one that cannot be traced, and of one that was no finalist.

    Catches a surface that cannot be traced taken for one that is refuted: the step of scenes/step.toml was then put the
    wrong way round.
    """
    one = lambda quick, full: Entry((Candidate(Turn(), (0, 1, 2)),), quick, full)  # noqa: E731
    margin = lambda *entries: Ranking(spheres, entries, 0.2, OrientSettings()).margin  # noqa: E731
    assert margin(one(1.0, 2.0)) == math.inf
    assert margin(one(1.0, 2.0), one(1.5, 5.0)) == pytest.approx(1.5)
    assert margin(one(1.0, 2.0), one(1.5, 5.0), one(0.9, math.inf)) == pytest.approx(-0.1)
    assert margin(one(1.0, 2.0), one(1.5, 5.0), one(1.3, math.nan)) == pytest.approx(0.3)
    assert margin(one(1.0, math.inf), one(9.0, math.inf)) == 0.0


def test_far_plate_leaves_hills_and_hollows_open(spheres):
    """Low relief, two bumps of 5 um over 900 um: with every slope reversed the images fit as well.

    Closed-form slopes' images from heights given here. The two candidates that a turn by 180 deg joins come first, and
    the refusal names them so. Catches a margin in which far-field reversal seems to be decided.
    """
    instrument = ring(20, 120, 250, d1=42.0)
    x, y = np.meshgrid(20.0 * np.arange(46) - 450.0, 20.0 * np.arange(46) - 450.0)
    width = 200.0
    height = 5.0 * (np.exp(-((x - 80) ** 2 + y**2) / width**2) + 0.6 * np.exp(-(x**2 + (y - 200) ** 2) / 120.0**2))
    down, along = np.gradient(height, 20.0)
    normal = np.stack([-along, -down, np.ones_like(x)]) / np.sqrt(1 + along**2 + down**2)
    mean = 1e6 * np.einsum("kiyx,iyx->kyx", form_factor(Optics.of(instrument), height), normal)
    counts = np.random.default_rng(5).poisson(mean).astype(float)
    stack = plain(instrument, counts, 1e6).replace(variance=mean)
    found = find_orientation(stack, OrientSettings(finalists=2))
    assert {e.ties[0] for e in found.entries[:2]} == {found.winner, found.winner.reversed}
    assert Turn() in (found.winner.turn, found.winner.reversed.turn) and found.winner.order == (0, 1, 2)
    with pytest.raises(GuardError, match="hollows for hills"):
        found.applied()


def test_five_detectors_keep_their_neighbours():
    """Ten orders, the file's own among them; each is a shift or a reversal of the ring, and the note says so.

    Catches an order that is no permutation, and a limit that is not told.
    """
    instrument = ring(72, 0, 216, 144, 288)
    orders, is_all = orders_tried(instrument)
    assert len(set(orders)) == 10 and not is_all and (0, 1, 2, 3, 4) in orders
    neighbours = {frozenset(p) for p in ((0, 1), (0, 3), (3, 2), (2, 4), (4, 1))}
    for order in orders:
        assert {frozenset((order[a], order[b])) for a, b in map(tuple, neighbours)} == neighbours


def test_given_by_hand_needs_no_fit(spheres, tmp_path, capsys):
    """Command line: all three given are applied as they are, even to flat counts; wrong names are told (exit code 2).

    Catches `--detectors` read as the image of each detector instead of the detector of each image.
    """
    stack = spheres.replace(counts=np.broadcast_to(np.array([1.0, 2.0, 3.0])[:, None, None], spheres.shape).copy())
    raw, out = tmp_path / "raw.h5", tmp_path / "turned.h5"
    write(stack, raw)
    a, b, c = spheres.instrument.detector_names
    command = ["orient", str(raw), "-o", str(out), "--turn", "90", "--no-mirror", "--json", "--detectors"]
    with pytest.raises(SystemExit) as end:
        main([*command, f"{b},{c},{a}"])
    assert end.value.code == 0 and json.loads(capsys.readouterr().out)["detectors"] == [b, c, a]
    turned = read(out)
    assert isinstance(turned, MicrographStack) and turned.shape == (3, 42, 34)
    assert turned.counts[:, 0, 0].tolist() == [3.0, 1.0, 2.0]
    assert turned.provenance["orient"]["margin"] is None
    with pytest.raises(SystemExit) as end:
        main([*command, f"{b},{b},{a}", "--force"])
    assert end.value.code == 2 and "must name the detector of each image once" in capsys.readouterr().err


def test_what_cannot_be_oriented_is_refused(spheres):
    """Two images, a list of positions, aligned or calibrated scans, wrong settings: each with its reason."""
    pair = spheres.instrument.model_copy(update={"detector": spheres.instrument.detector[:2]})
    with pytest.raises(GuardError, match="3 or more images"):
        find_orientation(plain(pair, np.ones((2, 14, 14))))
    line = plain(spheres.instrument, np.ones((3, 1, 9)))
    line = line.replace(y=np.zeros(1), positions=np.zeros((9, 2)))
    with pytest.raises(InputFileError, match="list of 9 positions"):
        find_orientation(line)
    with pytest.raises(InputFileError, match="before helio align"):
        find_orientation(spheres.replace(alignment=ScanAlignment()))
    with pytest.raises(InputFileError, match="before helio calibrate"):  # scaled to the flat of a wrong detector
        find_orientation(spheres.replace(calibration=Calibration("border")))
    with pytest.raises(SceneError, match="turn_deg"):
        OrientSettings().changed(turn_deg=45)
    with pytest.raises(SceneError, match="min_margins"):
        OrientSettings().changed(min_margins="1")


def test_measured_sphere_a_lies_as_imported(shared):
    """The real scan: `helio import`'s orientation and channels win, and hollows are rejected by the default margin.

    Its handedness stays open (the arrangement is its own mirror image). Catches an import that lies otherwise, and a
    fit that real background, gain and drift lead astray.
    """
    instrument = load_instrument(SCENES / "measured_sphere_a.toml")
    stack = import_micrographs(shared / "data" / "sc100351.mat", instrument)
    found = find_orientation(stack, OrientSettings(finalists=2))
    assert found.winner == Candidate(Turn(), (0, 1, 2)) and len(found.entries[0].ties) == 2
    assert found.margin > found.limit
