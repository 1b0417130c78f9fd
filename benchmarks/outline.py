"""How high a measured sphere stands, told by its outline alone: gains, backgrounds and angles hardly matter to it.

python benchmarks/outline.py STACK.h5 SCENE.toml [--center X Y]   (no stack: a sphere of our own, of known height)

Of the scene's sphere, of its radius, the more stands out of the flat the wider is the circle where it does. The same
edges (steepest change of brightness along rays from the centre, an ellipse through them) are taken from the measured
micrographs and from simulated ones of several cap heights; the height at which both are of one size is printed, per
axis and detector. A meniscus at the foot widens the outline; the raster's pitch is taken for right.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import rows  # noqa: E402
from helio_jax.formats.hdf5 import read_stack  # noqa: E402
from helio_jax.micrograph import MicrographStack  # noqa: E402
from helio_jax.workflows import pipeline  # noqa: E402
from helio_jax.workflows.compare import raster_of  # noqa: E402
from helio_jax.workflows.scene_file import load_scene  # noqa: E402

CAPS = 0.86, 1.0
"""Cap heights that are simulated, as shares of the scene's."""
RAYS, HALF_WIDTH = 72, 0.1
"""Directions in which the edge is looked for, and how far from the expected radius, as a share of it."""


def _edge_radii(image: np.ndarray, x: np.ndarray, y: np.ndarray, center: np.ndarray, radius: float) -> np.ndarray:
    """Return the radius of the steepest change of an image [y, x] in every direction [RAYS], um."""
    dx, dy = x[1] - x[0], y[1] - y[0]
    r = radius * np.linspace(1.0 - HALF_WIDTH, 1.0 + HALF_WIDTH, 41)
    fan = np.linspace(-0.04, 0.04, 5)
    out = np.empty(RAYS)
    for i, a in enumerate(2.0 * np.pi * np.arange(RAYS) / RAYS):
        px = center[0] + r[:, None] * np.cos(a + fan)
        py = center[1] + r[:, None] * np.sin(a + fan)
        profile = map_coordinates(image, [(py - y[0]) / dy, (px - x[0]) / dx], order=1, mode="nearest").mean(1)
        steepness = np.abs(np.gradient(np.convolve(profile, np.ones(7) / 7.0, "valid")))
        at = r[3:-3]
        weight = steepness**2 * (np.abs(at - at[np.argmax(steepness)]) < 0.04 * radius)
        out[i] = (at * weight).sum() / weight.sum()
    return out


def outline(image: np.ndarray, x: np.ndarray, y: np.ndarray, center: np.ndarray, radius: float) -> np.ndarray:
    """Return centre (x, y) and half-axes of the ellipse through a sphere's edge [4], um (in two passes)."""
    found = np.array([*center, radius, radius])
    for _ in range(2):
        r = _edge_radii(image, x, y, found[:2], radius)
        a = 2.0 * np.pi * np.arange(RAYS) / RAYS
        at = found[:2, None] + r * np.stack([np.cos(a), np.sin(a)])

        def misfit(q: np.ndarray, at: np.ndarray = at) -> np.ndarray:
            return radius * (np.hypot((at[0] - q[0]) / q[2], (at[1] - q[1]) / q[3]) - 1.0)

        found = least_squares(misfit, found, loss="soft_l1", f_scale=0.01 * radius).x
    return found


def cap_heights(stack: MicrographStack, scene_path: Path, rays: int, center: np.ndarray) -> np.ndarray:
    """Return the cap height that the outline tells, along x and y [detector, 2], um."""
    scene = load_scene(scene_path)
    sphere = scene.sample.model_dump()["spheres"][0]
    nominal, ball = sphere["cap_height_um"], sphere["radius_um"]
    x, y, radius = stack.x, stack.y, float(np.sqrt(ball**2 - (ball - nominal) ** 2))
    seen = np.stack([outline(image, x, y, center, radius) for image in stack.counts])
    shift = scene.beam_shift
    middle = np.median(seen[:, :2], axis=0) - 0.02 * ball * np.array([np.sign(shift[0]), np.sign(shift[1])])
    sizes = []
    for share in CAPS:
        changes = raster_of(stack, scene, (middle[0], middle[1]))
        changes |= {"trace.rays": rays, "sample.spheres.0.cap_height_um": share * nominal}
        made = pipeline.simulate(load_scene(scene_path, changes), maps=False).only()
        here = made.x + middle[0], made.y + middle[1]
        sizes.append([outline(image, *here, middle, radius)[2:] for image in made.counts])
    low, high = np.array(sizes)
    return nominal * (CAPS[0] + (CAPS[1] - CAPS[0]) * (seen[:, 2:] - low) / (high - low))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stack", type=Path, nargs="?")
    parser.add_argument("scene", type=Path, nargs="?", default=ROOT / "scenes" / "measured_sphere_a.toml")
    parser.add_argument("--rays", type=int, default=32)
    parser.add_argument("--center", type=float, nargs=2, default=(0.0, 0.0), help="roughly, of the outline [um]")
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--tiny", action="store_true", help="a sphere of our own, 5 % lower than the scene's")
    args = parser.parse_args()
    sphere = load_scene(args.scene).sample.model_dump()["spheres"][0]
    true = None
    if args.tiny or args.stack is None:
        true = 0.95 * sphere["cap_height_um"]
        changes = {"sample.spheres.0.cap_height_um": true, "trace.rays": 16, "trace.seed": 5}
        stack = pipeline.simulate(load_scene(args.scene, changes), maps=False).only()
    else:
        stack = read_stack(args.stack)
    found = cap_heights(stack, args.scene, 16 if args.tiny else args.rays, np.array(args.center))
    for name, (along, across) in zip(stack.instrument.detector_names, found, strict=True):
        print(f"{name:<12} cap height by the outline along x {along:.0f} um, along y {across:.0f} um")
    mean, spread = float(found.mean()), float(found.std(ddof=1) / np.sqrt(found.size))
    reached = None if true is None else bool(abs(mean - true) <= 0.015 * true)
    done = rows.row(
        "outline", stack.name, f"cap height {mean:.0f} +- {spread:.0f} um", f"{true or sphere['cap_height_um']:.0f} um",
        reached, heights_um=found.tolist(),
    )  # fmt: skip
    rows.write(args.output / ("outline_tiny.json" if args.tiny else "outline.json"), [done], 5)


if __name__ == "__main__":
    main()
