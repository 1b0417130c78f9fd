"""How exact and how fast the tracer is: closed forms, Embree against float64, scales, and time per bounce.

python benchmarks/tracer.py [--output benchmarks/out] [--rows 3,4,5,8,10,11,12,14] [--tiny]

Times are CPU times of one thread; ratios are taken within one run.
"""

import argparse
import importlib.util
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
sys.path.insert(0, str(ROOT))

from benchmarks.rows import Row, row, update, write  # noqa: E402
from benchmarks.tracer_plot import draw  # noqa: E402
from helio_jax.instrument import Beam, Detector, Instrument, Plate  # noqa: E402
from helio_jax.scene.shapes import Sphere, SpheresSample, StepSample, TrenchSample  # noqa: E402
from helio_jax.scene.surfaces import Body  # noqa: E402
from helio_jax.trace.converge import trace_to_target  # noqa: E402
from helio_jax.trace.intersect import MISS, Hits, Intersector  # noqa: E402
from helio_jax.trace.run import make_experiment, trace_pixels  # noqa: E402
from helio_jax.trace.settings import TraceSettings  # noqa: E402
from helio_jax.trace.tally import Estimate  # noqa: E402
from helio_jax.workflows.scene_file import load_scene  # noqa: E402

CLAUSING = {1: 0.671984, 2: 0.514231, 5: 0.310525, 10: 0.190941}
"""Transmission probability of a tube by length / radius.

Source: Gomez-Goni and Lobo, J. Vac. Sci. Technol. A 21 (2003) 1452."""
IMAGE_BLOCK = 4096
"""Pixels whose rays are shared out together."""
RADIUS = 1000.0
"""Of tubes and cavities, um."""


def around(z: np.ndarray, r: np.ndarray, n: int) -> Body:
    """Return a surface of revolution through the rings at heights z with radii r, n-sided; normals to the axis."""
    turn = 2.0 * np.pi * np.arange(n) / n
    rings = np.stack(np.broadcast_arrays(r[:, None] * np.cos(turn), r[:, None] * np.sin(turn), z[:, None]), -1)
    i, j = np.meshgrid(np.arange(len(z) - 1), np.arange(n), indexing="ij")
    a, b = i * n + j, i * n + (j + 1) % n
    faces = np.concatenate([np.stack(f, -1).reshape(-1, 3) for f in ((a, a + n, b), (b, a + n, b + n))])
    return Body(rings.reshape(-1, 3), faces)


def cavity(open_share: float, n: int) -> tuple[Body, Hits, Instrument]:
    """Return a sphere seen from inside with a hole at the top of a share of its area, its bottom, and the hole.

    The plate of the tracer lies above z = 0, so the cavity is lifted.
    """
    top, lift = 1.0 - 2.0 * open_share, 2.0 * RADIUS
    angle = np.linspace(np.pi, np.arccos(top), n)
    body = around(RADIUS * np.cos(angle) + lift, RADIUS * np.sin(angle), n)
    hole = above(RADIUS * top + lift, RADIUS * np.sqrt(1.0 - top**2))
    return body, upward(np.array([[0.0, 0.0, lift - RADIUS]])), hole


def upward(points: np.ndarray) -> Hits:
    """Return points [n, 3] on level facets, for atoms to start from."""
    return Hits.on_mesh(points, np.tile([0.0, 0.0, 1.0], (len(points), 1)))


def tube_transmission(ratio: float, n_points: int, rays: int) -> tuple[float, float]:
    """Return the share of atoms that pass a tube of a length over radius, and its standard error.

    They start in rings of equal area, one point in each; the error is taken from differences of neighbouring rings.
    """
    tube = around(np.array([0.0, ratio * RADIUS]), np.full(2, RADIUS), 720)
    rng = np.random.default_rng(1)
    ring = (np.arange(n_points) + rng.random(n_points)) / n_points
    r, turn = RADIUS * np.sqrt(ring), 2.0 * np.pi * rng.random(n_points)
    entrance = upward(np.stack([r * np.cos(turn), r * np.sin(turn), np.zeros(n_points)], -1))
    share = analog(tube, above(ratio * RADIUS, RADIUS), entrance, rays).hits.sum((0, 1)) / rays
    return float(share.mean()), float(np.sqrt(0.5 * np.mean(np.diff(share) ** 2) / n_points))


def above(height: float, radius: float) -> Instrument:
    """Return an instrument whose only aperture is a disc over the origin, at a height above z = 0."""
    disc = Detector(name="hole", center_um=(0.0, 0.0), axes_um=(2.0 * radius, 2.0 * radius))
    beam = Beam(incidence_deg=0.0, source="pencil", pinhole_radius_um=0.0)
    return Instrument(beam=beam, plate=Plate(working_distance_um=height), detector=(disc,))


def analog(body: Body, instrument: Instrument, first: Hits, rays: int, n_orders: int = 4):
    """Trace analog atoms from given points."""
    settings = TraceSettings(rays=rays, estimator="analog", max_events=2000, n_orders=n_orders, maps=False)
    zero = np.zeros(len(first.point))
    return trace_pixels(make_experiment(body, instrument, settings), zero, zero, first=first)


def judged(what: str, found: float, std: float, exact: float) -> Row:
    """Judge a measurement against a closed form: within 4 standard errors of 0.1 % or better."""
    good = abs(found - exact) <= 4.0 * std and std <= 1.05e-3 * exact
    return row("3", what, f"{found:.6f} +- {std:.6f}", f"{exact:.6f}", bool(good))


def closed_forms(scale: int) -> list[Row]:
    """Row 3: Clausing's tubes, a cavity with a hole, the floor of a slot, the length of a mask."""
    rows = []
    for ratio, exact in CLAUSING.items():
        n = 4000 // scale
        rays = max(int(1.2e6 * (1.0 / exact - 1.0) / n) + 1, 64) if scale == 1 else 64
        rows.append(judged(f"Clausing tube, length / radius {ratio}", *tube_transmission(ratio, n, rays), exact))
    open_share, n, rays = 0.1, 100, 150_000 // scale
    body, bottom, hole = cavity(open_share, 400)
    hits = analog(body, hole, bottom.take(np.zeros(n, int)), rays, n_orders=8).hits.sum((1, 2))
    for k in (0, 1, 4):
        exact = open_share * (1.0 - open_share) ** k
        found = hits[k] / (n * rays)
        std = np.sqrt(exact * (1.0 - exact) / (n * rays))
        rows.append(judged(f"sphere with a hole of a tenth of it, order {k + 1}", found, std, exact))
    width, depth = 400.0, 300.0
    slot = TrenchSample(width_um=width, length_um=60_000.0, depth_um=depth, size_um=80_000.0).build()
    wide = above(4000.0, 4e6)
    n, rays = 100, 20_000 // scale
    tally = analog(slot, wide, upward(np.tile([0.0, 0.0, -depth], (n, 1))), rays)
    exact = 1.0 / np.sqrt(1.0 + (2.0 * depth / width) ** 2)
    std = np.sqrt(exact * (1.0 - exact) / (n * rays))
    rows.append(judged("floor of a slot: share of the sky", tally.hits[0].sum() / (n * rays), std, exact))
    return rows + mask_lengths()


def mask_lengths() -> list[Row]:
    """Row 3: how long the mask of a step is in the raster, the source beside the detector and across from it."""
    rows, depth, polar, incidence = [], 200.0, 50.0, 25.0
    body = StepSample(height_um=depth).build()
    high = float(np.sign(np.mean(body.vertices[body.vertices[:, 2] > 0.5 * depth][:, 0])))
    low = body.vertices[body.vertices[:, 2] < 0.5 * depth][:, 0] * -high
    edge = -high * low.min()
    for is_across in (False, True):
        toward = 0.0 if high > 0 else 180.0  # the detector looks over the high side
        beam_azimuth = toward + (0.0 if is_across else 180.0)  # where the beam flies to
        detector = Detector(name="n", polar_deg=polar, azimuth_deg=toward, half_angle_deg=0.05)
        beam = Beam(incidence_deg=incidence, azimuth_deg=beam_azimuth % 360.0, source="pencil", pinhole_radius_um=0.0)
        plate = Plate(working_distance_um=4000.0)
        instrument = Instrument(beam=beam, plate=plate, detector=(detector,))
        top_edge = edge + depth * instrument.beam_shift[0]
        sign = 1.0 if is_across else -1.0
        center = abs(instrument.apertures()[0].center[0])
        exact = depth * (center / 4000.0 + sign * np.tan(np.radians(incidence)))
        length = np.arange(0.9 * exact, 1.1 * exact, 0.02)
        x = top_edge - high * length
        settings = TraceSettings(rays=8, branches=1, n_orders=1)
        single = trace_pixels(make_experiment(body, instrument, settings), x, np.zeros(x.size)).probability()[0][0, 0]
        found = float(np.interp(0.5, np.clip(single / single.max(), 0.0, 1.0), length))
        where = "across from" if is_across else "beside"
        rows.append(
            judged(f"mask of a step, source {where} the detector [um]", found, 5e-4 * float(exact), float(exact))
        )
    return rows


ROUNDING = 8 * np.finfo(np.float32).eps * RADIUS
"""What Embree's float32 may move rays and surfaces of a scene of this half-size, um."""


def engines(n_rays: int, n_flights: float) -> list[Row]:
    """Row 4: Embree against float64 with grazing rays and rays at edges; leaks of a closed mesh."""
    angle = np.linspace(np.pi, 0.0, 33)
    body = around(RADIUS * np.cos(angle), RADIUS * np.sin(angle), 32)
    rng = np.random.default_rng(2)
    corners = body.vertices[body.faces]
    pick = rng.integers(len(corners), size=n_rays)
    edge = 0.5 * (corners[pick, 0] + corners[pick, 1])  # middles of edges, vertices, and points between
    target = np.where(rng.random((n_rays, 1)) < 0.5, edge, corners[pick, 2])
    target = target + np.where(rng.random((n_rays, 1)) < 0.5, 1e-3, 30.0) * rng.normal(size=(n_rays, 3))
    out = target / np.linalg.norm(target, axis=1, keepdims=True)
    side = np.cross(out, rng.normal(size=(n_rays, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    lean = np.where(rng.random((n_rays, 1)) < 0.5, 1e-3, 1.0) * rng.random((n_rays, 1))
    direction = side - lean * out
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = target - 800.0 * direction
    skip = np.full(n_rays, -1, np.int32)
    a, b = (Intersector(body, engine).nearest(origin, direction, skip) for engine in ("embree", "exhaustive"))
    differ = np.flatnonzero(a.surface != b.surface)
    # Both hits lie on the ray, so they may differ by the rounding of the surface over the cosine; one engine alone, or
    # another place, is explained where the ray passes an edge within the rounding.
    moved = np.linalg.norm(a.point[differ] - b.point[differ], axis=1)
    cosine = np.abs(np.sum(a.normal[differ] * direction[differ], 1))
    missed = (a.surface[differ] == MISS) | (b.surface[differ] == MISS)
    is_same_place = ~missed & (moved * cosine < ROUNDING)
    n_left = int(np.sum(~is_same_place & (_edge_distance(origin[differ], direction[differ], body) >= ROUNDING)))
    text = f"{differ.size} other triangles, {n_left} unexplained"
    rows = [row("4", f"{n_rays} rays at edges and grazing, Embree and float64", text, "0 unexplained", n_left == 0)]
    angle = np.linspace(np.pi, 0.0, 200)
    closed = around(RADIUS * np.cos(angle) + 2.0 * RADIUS, RADIUS * np.sin(angle), 200)
    n, events = 512, 1000
    rays = max(int(n_flights / events / n), 1)
    settings = TraceSettings(rays=max(rays, 8), estimator="analog", max_events=events, maps=False)
    experiment = make_experiment(closed, above(5.0 * RADIUS, RADIUS), settings)
    start = upward(np.tile([0.0, 0.0, RADIUS], (n, 1)))
    tally = trace_pixels(experiment, np.zeros(n), np.zeros(n), first=start, max_lost=1.0)
    fates = tally.fates.sum(1)
    out_of = fates[0] + fates[1]
    text = f"{out_of} escaped, {fates[3]} lost of {n * settings.rays * events:.3g}"
    rows.append(row("4", "flights in a closed mesh", text, "no leak", bool(out_of == 0), lost=int(fates[3])))
    return rows


def _edge_distance(origin: np.ndarray, direction: np.ndarray, body: Body) -> np.ndarray:
    """Return how near each ray passes an edge of any triangle [n], um."""
    out = np.empty(len(origin))
    corners = body.vertices[body.faces]
    start = np.concatenate([corners[:, i] for i in range(3)])
    along = np.concatenate([corners[:, (i + 1) % 3] - corners[:, i] for i in range(3)])
    for i, (o, d) in enumerate(zip(origin, direction, strict=True)):
        w = start - o
        a, b, dw, ew = along @ d, np.sum(along**2, 1), w @ d, np.sum(along * w, 1)
        t = np.clip((a * dw - ew) / np.maximum(b - a**2, 1e-30), 0.0, 1.0)
        gap = w + t[:, None] * along
        gap -= (gap @ d)[:, None] * d
        out[i] = np.linalg.norm(gap, axis=1).min()
    return out


def sphere_a(scale: float = 1.0, shift: float = 0.0) -> Body:
    """Return sphere A as a mesh, all lengths times `scale`, moved along x [um]."""
    turn = np.linspace(0.0, np.arccos(0.28), 60)[1:]
    dome = around((np.cos(turn) - 0.28) * RADIUS, np.sin(turn) * RADIUS, 240)
    top = np.array([[0.0, 0.0, 0.72 * RADIUS]])
    n, rim = 240, len(dome.vertices)
    ring = np.arange(n)
    cap = np.stack([np.full(n, rim), ring, (ring + 1) % n], -1)
    outer = dome.vertices[-n:] * [4.0, 4.0, 0.0]
    a, b = rim - n + ring, rim - n + (ring + 1) % n
    c, d = rim + 1 + ring, rim + 1 + (ring + 1) % n
    flat = np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)])
    vertices = np.concatenate([dome.vertices, top, outer])
    body = Body(scale * vertices + [shift, 0.0, 0.0], np.concatenate([dome.faces[:, ::1], cap, flat]))
    return body


def scales(rays: int) -> list[Row]:
    """Row 5: sphere A a thousand times smaller and larger, and 10 m off the origin."""
    base = load_scene(ROOT / "scenes" / "sphere_a.toml").instrument
    axis = np.linspace(-1400.0, 1400.0, 21)
    x, y = (g.ravel() for g in np.meshgrid(axis, axis))
    settings = TraceSettings(rays=rays, branches=4, maps=False)

    def counts(scale: float, shift: float):
        plate = Plate(
            working_distance_um=scale * base.working_distance, sample_distance_um=scale * base.sample_distance
        )
        detectors = tuple(
            d.model_copy(
                update={
                    "center_um": tuple(scale * np.array(d.center_um, float)),
                    "axes_um": tuple(scale * np.array(d.axes_um, float)),
                }
            )
            for d in base.detector
        )
        beam = base.beam.model_copy(update={"pinhole_radius_um": scale * base.beam.pinhole_radius_um})
        instrument = Instrument(beam=beam, plate=plate, detector=detectors)
        experiment = make_experiment(sphere_a(scale, shift), instrument, settings)
        mean, variance = trace_pixels(experiment, scale * x + shift, scale * y).total()
        return mean, variance

    mean, variance = counts(1.0, 0.0)
    rows = []
    for scale, shift in ((1e-3, 0.0), (1e3, 0.0), (1.0, 1e7)):
        other, _ = counts(scale, shift)
        z = (other - mean) / np.sqrt(2.0 * variance + 1e-30)
        # the same random numbers: only rays that pass an edge on its other side differ
        worst, change = float(np.abs(z).max()), float(np.abs(other.sum() / mean.sum() - 1.0))
        text = f"sum differs by {change:.1e}, worst pixel {worst:.2f} s.d."
        rows.append(row("5", f"lengths x {scale:g}, {shift * 1e-6:g} m off", text, "same within error", worst < 5.0))
    return rows


MISSED = np.uint32(2**32 - 1)
"""Embree's triangle of a ray that meets none."""


class Spy:
    """An Embree scene that keeps the rays it is asked about."""

    def __init__(self, scene, seen: list) -> None:
        self.scene, self.seen = scene, seen

    def run(self, origins, directions, **how):
        self.seen.append((origins.copy(), directions.copy()))
        return self.scene.run(origins, directions, **how)


def bounced(n: int, n_rays: int) -> tuple[Intersector, Callable[[], None], Callable[[], list], list]:
    """Return a cavity, what traces analog atoms in it, what asks Embree alone about all their rays, and these rays."""
    body, start, hole = cavity(0.05, n)
    settings = TraceSettings(rays=n_rays, estimator="analog", max_events=30, maps=False)
    experiment = make_experiment(body, hole, settings)
    embree: Any = experiment.intersector._embree
    seen, zero = [], np.zeros(1)

    def trace() -> None:
        trace_pixels(experiment, zero, zero, workers=1, first=start)

    trace()
    experiment.intersector._embree = Spy(embree, seen)
    trace()
    experiment.intersector._embree = embree
    return experiment.intersector, trace, lambda: [embree.run(o, d, output=True) for o, d in seen], seen


def cpu_seconds(work: Callable[[], Any]) -> float:
    """Return the CPU time that a call takes."""
    start = time.process_time()
    work()
    return time.process_time() - start


def bounce_rows(sizes: tuple[int, ...], n_rays: int) -> list[Row]:
    """Row 8: the analog bounce loop against the bare embreex call on the same rays."""
    rows = []
    for n in sizes:
        surface, trace, ask, seen = bounced(n, n_rays)
        flights = sum(len(o) for o, _ in seen)
        kept = [(cpu_seconds(trace), cpu_seconds(ask)) for _ in range(5)]
        ratio = float(np.median([a / b for a, b in kept]))
        ours, bare = (1e9 * float(np.median(v)) / flights for v in zip(*kept, strict=True))
        n_faces = len(surface.triangles)
        target = 1.6 if n_faces < 20_000 else 1.4
        text = f"{ours:.0f} / {bare:.0f} ns = {ratio:.2f}"
        what = f"bounce loop / bare embreex, {n_faces} triangles"
        more = {"flights": flights, "triangles": n_faces, "ratio": ratio}
        rows.append(row("8", what, text, f"<= {target}", ratio <= target, **more))
    return rows


def mitsuba_rows(n: int, n_rays: int) -> list[Row]:
    """Row 14: the same rays through Mitsuba 3 (LLVM backend, one thread), and whether it meets the same triangles."""
    what = "the same rays through Mitsuba 3"
    if importlib.util.find_spec("mitsuba") is None:
        return [row("14", what, "not measured: pip install 'helio-jax[bench]'", "report", None)]
    import drjit as dr
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(0)
    surface, trace, ask, seen = bounced(n, n_rays)
    mesh = mi.Mesh("cavity", len(surface.vertices), len(surface.triangles))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = (
        ((surface.vertices - surface.center) / surface.half_size).astype(np.float32).ravel()
    )
    parameters["faces"] = surface.triangles.astype(np.uint32).ravel()
    parameters.update()
    scene = mi.load_dict({"type": "scene", "cavity": mesh})
    rays = [mi.Ray3f(mi.Point3f(o.T), mi.Vector3f(d.T)) for o, d in seen]
    dr.eval(rays)

    def query(ray: Any) -> Any:
        hit = scene.ray_intersect_preliminary(ray, coherent=False)
        dr.eval(hit.prim_index, hit.prim_uv, hit.t)
        dr.sync_thread()
        return hit

    hits = list(map(query, rays))  # compiles, too
    found = np.concatenate([np.where(np.isfinite(np.array(h.t)), np.array(h.prim_index), MISSED) for h in hits])
    ours = np.concatenate([answer["primID"] for answer in ask()]).astype(np.uint32)
    same = float(np.mean(found == ours))
    kept = [[cpu_seconds(work) for work in (trace, lambda: list(map(query, rays)), ask)] for _ in range(5)]
    flights = sum(len(o) for o, _ in seen)
    whole, theirs, bare = (1e9 * float(np.median(v)) / flights for v in zip(*kept, strict=True))
    text = f"{theirs:.0f} ns, bare embreex {bare:.0f} ns, our bounce {whole:.0f} ns; {same:.2%} the same triangle"
    return [row("14", f"{what}, {len(surface.triangles)} triangles", text, "report", None, ratio=theirs / bare)]


def image_row(tiny: bool) -> list[Row]:
    """Row 10: the data pack's image, every pixel at the counting error of 35 000 analog rays or below."""
    overrides = {"scan.nx": 24, "scan.ny": 24, "scan.pixel_size_um": 140.0} if tiny else {}
    scene = load_scene(ROOT / "scenes" / "sphere_a_full.toml", overrides)
    x, y = (g.ravel() for g in np.meshgrid(*scene.scan.positions(scene.instrument.beam)))
    n = 35_000.0
    settings = TraceSettings(rays=32, branches=16, n_orders=2, maps=False, target_atoms=n, max_rays=512)
    experiment = make_experiment(scene.build_body(), scene.instrument, settings)
    trace_to_target(experiment, settings, np.arange(64), x[:64], y[:64])
    start, parts = time.process_time(), []
    for first in range(0, x.size, IMAGE_BLOCK):
        some = np.arange(first, min(first + IMAGE_BLOCK, x.size))
        parts.append(trace_to_target(experiment, settings, some, x[some], y[some]))
    seconds = time.process_time() - start
    mean, variance = Estimate.join(parts).probability()
    # the stated variance of one pixel has 7 degrees of freedom: neighbours of 25 pixels are taken together
    size = scene.scan.ny, scene.scan.nx
    ratio = []
    for order in range(2):
        own, counting = (
            _block_mean(a[order].reshape(-1, *size), 5) for a in (n**2 * variance, n * np.maximum(mean, 0.0))
        )
        ratio.append(float(np.max(own / np.maximum(counting, 1e-3 * counting.max()))))
    n_rays = float(np.mean(np.concatenate([part.n_rays for part in parts])))
    text = f"{seconds:.1f} s, {n_rays:.0f} rays; largest ratio {ratio[0]:.2f} single, {ratio[1]:.2f} multiple"
    return [row("10", f"{size[0]} x {size[1]} x 3 image", text, "60 s; ratios <= 1", seconds <= 60 and max(ratio) <= 1)]


def _block_mean(image: np.ndarray, n: int) -> np.ndarray:
    """Return the means of blocks of n x n pixels [detector, y, x]."""
    k, ny, nx = (image.shape[0], image.shape[1] // n, image.shape[2] // n)
    return image[:, : ny * n, : nx * n].reshape(k, ny, n, nx, n).mean((2, 4))


def efficiency_rows(n_side: int) -> list[Row]:
    """Row 11: variance x time of multiple scattering, expected over analog."""
    rows = []
    spheres = SpheresSample(spheres=(Sphere(radius_um=1000.0, cap_height_um=720.0),), size_um=8000.0).build()
    slot = TrenchSample(width_um=400.0, length_um=6000.0, depth_um=400.0, size_um=8000.0).build()
    instrument = load_scene(ROOT / "scenes" / "sphere_a.toml").instrument
    for name, body, reach in (("sphere A", spheres, 1300.0), ("trench", slot, 250.0)):
        axis = np.linspace(-reach, reach, n_side)
        x, y = (g.ravel() for g in np.meshgrid(axis, axis))
        cost = {}
        for kind, rays in (("expected", 64), ("analog", 4096)):
            values = {"rays": rays, "branches": 8, "estimator": kind, "n_orders": 2, "maps": False}
            settings = TraceSettings.model_validate(values)
            experiment = make_experiment(body, instrument, settings)
            trace_pixels(experiment, x[:16], y[:16], workers=1)
            start = time.process_time()
            mean, variance = trace_pixels(experiment, x, y, workers=1).probability()
            seconds = time.process_time() - start
            if kind == "expected":
                truth = mean[1]
                cost[kind] = variance[1] * seconds
            else:
                cost[kind] = truth / settings.rays * seconds  # Poisson, with the better estimate of the mean
        is_lit = truth > 0.02 * truth.max()
        gain = (cost["analog"] / np.maximum(cost["expected"], 1e-300))[is_lit]
        mean_gain = float(cost["analog"][is_lit].mean() / cost["expected"][is_lit].mean())
        tenth = float(np.quantile(gain, 0.1))
        text = f"{mean_gain:.1f} x; worst decile {tenth:.1f} x"
        target = "25 x; 5 x"
        rows.append(row("11", f"multiple scattering on {name}", text, target, mean_gain >= 25.0 and tenth >= 5.0))
    return rows


def size_rows(sizes: tuple[int, ...], n_rays: int) -> list[Row]:
    """Row 12: analog rays per second against the number of triangles of a rough sheet."""
    rows, rates = [], []
    instrument = load_scene(ROOT / "scenes" / "sphere_a.toml").instrument
    axis = np.linspace(-1000.0, 1000.0, 32)
    x, y = (g.ravel() for g in np.meshgrid(axis, axis))
    for n in sizes:
        side = np.linspace(-4000.0, 4000.0, n)
        gx, gy = np.meshgrid(side, side)
        height = 30.0 * np.sin(gx / 170.0) * np.cos(gy / 190.0)
        i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
        faces = np.concatenate([np.stack([i, i + 1, i + n], -1), np.stack([i + 1, i + n + 1, i + n], -1)])
        body = Body(np.stack([gx, gy, height], -1).reshape(-1, 3), faces)
        experiment = make_experiment(body, instrument, TraceSettings(rays=n_rays, estimator="analog", maps=False))
        trace_pixels(experiment, x[:8], y[:8], workers=1)
        start = time.process_time()
        trace_pixels(experiment, x, y, workers=1)
        rates.append(x.size * n_rays / (time.process_time() - start))
        text, share = f"{rates[-1]:.3g} rays/s", rates[-1] / rates[0]
        is_last = n == sizes[-1]
        rows.append(
            row(
                "12",
                f"{len(faces)} triangles",
                text,
                ">= 1/5 of the first",
                share >= 0.2 if is_last else None,
                triangles=len(faces),
                rays_per_second=rates[-1],
            )
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--rows", default="3,4,5,8,10,11,12,14")
    parser.add_argument("--tiny", action="store_true")
    parser.add_argument("--update", action="store_true", help="also put the rows into benchmarks/results, with a plot")
    args = parser.parse_args()
    tiny = args.tiny
    work = {
        "3": lambda: closed_forms(100 if tiny else 1),
        "4": lambda: engines(2000 if tiny else 200_000, 2e5 if tiny else 3e8),
        "5": lambda: scales(8 if tiny else 64),
        "8": lambda: bounce_rows((20,) if tiny else (51, 201, 807), 1000 if tiny else 60_000),
        "10": lambda: image_row(tiny),
        "11": lambda: efficiency_rows(3 if tiny else 21),
        "12": lambda: size_rows((24,) if tiny else (24, 72, 224, 708), 8 if tiny else 256),
        "14": lambda: mitsuba_rows(20 if tiny else 201, 1000 if tiny else 60_000),
    }
    rows = [r for name in args.rows.split(",") for r in work[name]()]
    write(args.output / ("tracer_tiny.json" if tiny else "tracer.json"), rows, seed=1)
    if args.update and not tiny:
        update(RESULTS / "tracer.json", rows, seed=1)
        draw(RESULTS / "tracer.json", RESULTS / "tracer.png")
    elif tiny:
        draw(args.output / "tracer_tiny.json", args.output / "tracer_tiny.png")


if __name__ == "__main__":
    main()
