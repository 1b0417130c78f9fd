"""The render model: against the tracer on six scenes, what it compiles, and the time of batches and gradients.

The tracer has two surfaces: the sample's own, and the one that the render model was given: the heights at the beam
positions, as `masking` interpolates them. What the two differ by is relief within a pixel, which no model can know.

python benchmarks/render.py [--output benchmarks/out] [--rows 1,3,5,6] [--tiny]

Row numbers are those of the render model's issue. Times are wall times, the least of several, without compilation;
ratios are taken within one run, the two sides in turns. Numbers are float64.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import helio_jax as hx  # noqa: E402
from benchmarks.rows import Row, row, write  # noqa: E402
from helio_jax.arrays import WALL_PITCHES  # noqa: E402
from helio_jax.forward.surface import slopes_of_normal  # noqa: E402
from helio_jax.scene.body import Body  # noqa: E402
from helio_jax.scene.surfaces import surface_body  # noqa: E402
from helio_jax.trace.intersect import Hits  # noqa: E402
from helio_jax.trace.run import MAX_LOST, make_experiment, trace_pixels  # noqa: E402
from helio_jax.workflows.scene_file import load_instrument, load_scene  # noqa: E402
from helio_jax.workflows.truth import true_surface  # noqa: E402
from tests.compilations import counted  # noqa: E402

N_GEOMETRIES, N_BATCH = 20, 16
LEAST_TIME = 4.0
"""Least time of a measurement [s]."""
SCENES: dict[str, tuple[str, dict[str, Any]]] = {
    "sphere": ("sphere_a", {"scan.nx": 41, "scan.ny": 41, "scan.pixel_size_um": 80.0}),
    "step": ("step", {"scan.nx": 61, "scan.ny": 31, "scan.pixel_size_um": 20.0, "scan.center_um": [3.0, 4.0]}),
    "slot": (
        "trench",
        {
            "sample.width_um": 240.0,
            "sample.depth_um": 120.0,
            "scan.nx": 61,
            "scan.ny": 31,
            "scan.pixel_size_um": 20.0,
            "scan.center_um": [3.0, 4.0],
        },
    ),
    "pyramid": ("pyramid", {"scan.nx": 41, "scan.ny": 41, "scan.pixel_size_um": 30.0}),
    "rough": ("rough", {"scan.nx": 65, "scan.ny": 65, "scan.pixel_size_um": 20.0, "scan.center_um": [7.0, 5.0]}),
    "4 detectors": ("sphere_a", {"scan.nx": 41, "scan.ny": 41, "scan.pixel_size_um": 80.0}),
}
"""Scene file and changes of each compared scene. The centres keep beam positions off vertical walls and rims."""


_HALF_WALL = 1e-3
"""Half the width of a wall of the given surface, in pitches."""
_LIFT = 1e-3
"""How far off the given surface its points are put [um]."""
_MAX_BURIED = 0.02
"""Largest share of atoms that may start below a neighbouring facet of the given surface: normals are the sample's."""

_LEAST_NOISE = 1e-6
"""Least standard error, relative to the mean, of values that are compared with it."""


class Comparison(NamedTuple):
    """Rendered and traced detection probabilities of one scene [detector, y, x], with standard errors of the traced."""

    single: np.ndarray
    total: np.ndarray
    traced_single: np.ndarray
    traced_total: np.ndarray
    single_error: np.ndarray
    total_error: np.ndarray

    @property
    def single_bias(self) -> float:
        """Relative error of the mean of single scattering."""
        return float(self.single.mean() / self.traced_single.mean() - 1.0)

    @property
    def total_bias(self) -> float:
        """Relative error of the mean of all orders."""
        return float(self.total.mean() / self.traced_total.mean() - 1.0)

    @property
    def difference(self) -> np.ndarray:
        """Differences of single scattering over the traced mean [detector, y, x]."""
        return (self.single - self.traced_single) / self.traced_single.mean()


class Comparisons(NamedTuple):
    """One rendered scene against the tracer on the sample, and on the surface that the render model was given."""

    sample: Comparison
    given: Comparison


def nodes_of_cells(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Place three nodes per cell along an axis: at the pixel and on both sides of the cell's middle.

    Returns:
        Number of the pixel before each node, and distance from it in pitches.
    """
    share = np.array([0.0, 0.5 - _HALF_WALL, 0.5 + _HALF_WALL])
    before, after = np.repeat(np.arange(n - 1), 3), np.tile(share, n - 1)
    return np.append(before, n - 2), np.append(after, 1.0)


def interpolate_heights(height: np.ndarray, tall: float) -> np.ndarray:
    """Interpolate heights [y, x] to the nodes of `nodes_of_cells`: linearly, with walls half-way between pixels.

    Differences above `tall`, um, are walls: the rule of `helio_jax.forward.horizon`.
    """
    for axis in (0, 1):
        first, share = nodes_of_cells(height.shape[axis])
        share = np.expand_dims(share, 1 - axis)
        low, step = np.take(height, first, axis), np.take(np.diff(height, axis=axis), first, axis)
        height = low + np.where(np.abs(step) > tall, share > 0.5, share) * step
    return height


def given_body(height: np.ndarray, raster: hx.Raster, instrument: hx.Instrument, substrate: float) -> Body:
    """Make the mesh of heights at the beam positions [y, x], um, within a substrate of side `substrate`, um."""
    tall = WALL_PITCHES * max(raster.dx, raster.dy)
    z = interpolate_heights(height, tall)
    y, x = (np.interp(np.add(*nodes_of_cells(a.size)), np.arange(a.size), a) for a in (raster.y, raster.x))
    at_x, at_y = instrument.surface_position(*np.meshgrid(x, y), z)
    return surface_body(at_x, at_y, z, 0.5 * substrate, level=0.0, beam_shift=instrument.beam_shift)


def compare(name: str, rays: int, finer: int = 1) -> Comparisons:
    """Render and trace a scene of `SCENES` from its true heights and normals, with `finer` times as many rows."""
    file, changes = SCENES[name]
    size = {key: finer * changes[key] for key in ("scan.nx", "scan.ny")}
    size["scan.pixel_size_um"] = changes["scan.pixel_size_um"] / finer
    scene = load_scene(ROOT / "scenes" / f"{file}.toml", changes | size)
    instrument = scene.instrument
    if name == "4 detectors":
        four = load_instrument(ROOT / "scenes" / "instruments" / "bshem_4detector.toml")
        instrument = four.at_distance(instrument.sample_distance)
    x, y = scene.positions()
    truth = true_surface(scene, x, y)
    assert truth.normals is not None  # of a scene
    settings = scene.trace.changed(rays=rays, branches=8, n_orders=2, maps=False)
    optics, raster = hx.Optics.of(instrument), hx.Raster(x, y)
    surface = hx.Surface(truth.height, *slopes_of_normal(truth.normals, instrument.beam_shift)[:2])
    plan = hx.plan_radiosity(truth.height, truth.normals, optics, raster, substrate_um=scene.substrate_size)
    single, both = (np.asarray(hx.render(surface, optics, raster, corrections=c)) for c in ("masking", plan))
    at_x, at_y = np.meshgrid(x, y)
    normal = truth.normals.reshape(-1, 3)
    point = np.stack([*instrument.surface_position(at_x, at_y, truth.height), truth.height], -1).reshape(-1, 3)
    first = Hits.on_mesh(point + _LIFT * normal, normal)

    def against(body: Body, first: Hits | None, max_lost: float) -> Comparison:
        experiment = make_experiment(body, instrument, settings)
        estimate = trace_pixels(experiment, at_x.ravel(), at_y.ravel(), first=first, max_lost=max_lost)
        mean, variance = (a.reshape(*a.shape[:2], y.size, x.size) for a in estimate.probability())
        total, total_variance = (a.reshape(-1, y.size, x.size) for a in estimate.total())
        return Comparison(single, both, mean[0], total, np.sqrt(variance[0]), np.sqrt(total_variance))

    given = given_body(truth.height, raster, instrument, scene.substrate_size)
    return Comparisons(against(scene.build_body(), None, MAX_LOST), against(given, first, _MAX_BURIED))


def scene_rows(rays: int, names: tuple[str, ...]) -> list[Row]:
    """Row 3: means and worst pixels of six scenes, against the sample and against the given surface."""
    rows = []
    for name in names:
        for of, found in zip(("", ", given surface"), compare(name, rays), strict=True):
            gap = np.abs(found.difference)
            is_noisy = found.total_error > _LEAST_NOISE * found.traced_total.mean()
            z = (np.abs(found.total - found.traced_total)[is_noisy]) / found.total_error[is_noisy]
            worst, off, largest = float(gap.max()), float(np.mean(gap > 0.01)), float(np.median(z))
            text = f"mean {found.single_bias:+.1e}; {off:.1%} of pixels > 1 %, worst {worst:.0%}"
            is_reached = abs(found.single_bias) < 1e-3
            rows.append(row("3", f"single scattering, {name}{of}", text, "mean within 1e-3", is_reached, worst=worst))
            text = f"mean {found.total_bias:+.1e}; median |z| {largest:.1f}, worst {z.max():.0f}"
            is_reached, worst = abs(found.total_bias) < 1e-2, float(z.max())
            rows.append(row("3", f"with radiosity, {name}{of}", text, "mean within 1e-2", is_reached, worst_z=worst))
    return rows


def example(n: int) -> tuple[np.ndarray, hx.Optics, hx.Raster]:
    """Make sphere A's heights on an n x n raster over 4 mm, its optics and raster."""
    scene = load_scene(ROOT / "scenes" / "sphere_a.toml")
    raster = hx.Raster.regular((n, n), 4000.0 / n)
    return true_surface(scene, raster.x, raster.y).height, hx.Optics.of(scene.instrument), raster


def least_times(works: list[Callable[[], Any]], repeats: int) -> list[float]:
    """Measure calls in turns, so that all meet the same other load; return the least time of each [s].

    Short calls are repeated more often, for `LEAST_TIME` in all.
    """
    best, begin, n = [np.inf] * len(works), time.perf_counter(), 0
    while n < repeats or (repeats > 1 and time.perf_counter() - begin < LEAST_TIME):
        n += 1
        for k, work in enumerate(works):
            start = time.perf_counter()
            jax.block_until_ready(work())
            best[k] = min(best[k], time.perf_counter() - start)
    return best


def compilation_rows(n: int) -> list[Row]:
    """Row 1: programs compiled for 20 more geometries and surfaces on one raster."""
    height, optics, raster = example(n)
    rows = []
    for kind in ("none", "masking"):
        hx.render(height, optics.moved(distance=1.0), raster, corrections=kind)
        with counted() as programs:
            for i in range(N_GEOMETRIES):
                moved = optics.moved(distance=10.0 * i, polar=1e-3 * i, tilt=(1e-3 * i, 0.0), incidence=1e-3 * i)
                hx.render(height * (1.0 + 0.01 * i), moved, raster, corrections=kind)
        count = sum(programs.values())
        text = f"{count} programs after the first geometry"
        rows.append(row("1", f"{N_GEOMETRIES} geometries, {kind}", text, "0", count == 0, programs=dict(programs)))
    return rows


def batch_rows(n: int, repeats: int) -> list[Row]:
    """Row 5: vmap over 16 geometries against a loop of the compiled function."""
    height, optics, raster = example(n)
    rows = []
    with jax.enable_x64(True):
        height, distances = jnp.asarray(height), jnp.linspace(-100.0, 100.0, N_BATCH)
        for kind in ("none", "masking"):

            def one(distance: Any, kind: Any = kind) -> jax.Array:
                return hx.render(height, optics.moved(distance=distance), raster, corrections=kind)

            single, batch = jax.jit(one), jax.jit(jax.vmap(one))
            works = [lambda f=single: [f(d) for d in distances], lambda f=batch: f(distances)]
            gap = float(np.abs(np.stack(works[0]()) - works[1]()).max() / np.abs(works[1]()).max())
            loop, together = least_times(works, repeats)
            text = f"{together / loop:.2f} of the loop's time ({loop:.2f} s); differs by {gap:.0e}"
            is_reached = together < loop and gap < 1e-12
            rows.append(row("5", f"vmap of {N_BATCH}, {n} x {n} x 3, {kind}", text, "< 1; 1e-12", is_reached))
    return rows


def gradient_rows(n: int, repeats: int) -> list[Row]:
    """Row 6: time of the gradient of a whole image over the time of the image."""
    height, optics, raster = example(n)
    rows = []
    with jax.enable_x64(True):
        height, optics = jnp.asarray(height), jax.tree.map(jnp.asarray, optics)
        for kind in ("none", "masking"):

            def total(height: Any, optics: hx.Optics, kind: Any = kind) -> jax.Array:
                return jnp.sum(hx.render(height, optics, raster, corrections=kind) ** 2)

            functions = [jax.jit(f) for f in (total, jax.grad(total), jax.grad(total, 1))]
            works = [lambda f=f: f(height, optics) for f in functions]
            for work in works:
                work()
            image, *gradients = least_times(works, repeats)
            for what, seconds in zip(("the heights", "all optics"), gradients, strict=True):
                text = f"{seconds / image:.1f} times the image's {1e3 * image:.0f} ms"
                is_reached = seconds < 5.0 * image
                rows.append(row("6", f"gradient in {what}, {n} x {n} x 3, {kind}", text, "<= 5", is_reached))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--rows", default="1,3,5,6")
    parser.add_argument("--tiny", action="store_true")
    args = parser.parse_args()
    tiny = args.tiny
    n, repeats = (12, 1) if tiny else (121, 7)
    work = {
        "1": lambda: compilation_rows(n),
        "3": lambda: scene_rows(8 if tiny else 64, ("step",) if tiny else tuple(SCENES)),
        "5": lambda: [r for size in (n // 4, n) for r in batch_rows(size, repeats)],
        "6": lambda: gradient_rows(n, repeats),
    }
    rows = [r for name in args.rows.split(",") for r in work[name]()]
    write(args.output / ("render_tiny.json" if tiny else "render.json"), rows, seed=1)


if __name__ == "__main__":
    main()
