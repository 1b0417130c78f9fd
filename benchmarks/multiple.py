"""Multiple scattering as `refine` predicts it from the heights of the pixels, against the tracer on the true sample.

    python benchmarks/multiple.py [--shapes pyramid,half ball,...] [--families smooth,free,mesa,overhang] [--members 3]
        [--rays 1024] [--seed 11] [--tiny] [--output benchmarks/out]

The prediction is made at the true heights and normals, so that no error is that of a fit. Errors are those of the mean
over all detectors and the pixels of a region: slopes of more than 20 degrees, and what is level within 1 to 3, and 3 to
9, pixels of them. In per cent of the multiple scattering there (and, in brackets, of a level substrate's signal).
"""

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.known_shape import PYRAMID, PYRAMID_PITCH  # noqa: E402
from benchmarks.rows import Row, row, write  # noqa: E402
from benchmarks.shapes import members  # noqa: E402
from helio_jax.workflows import pipeline  # noqa: E402
from helio_jax.workflows.corrections import make_predictor  # noqa: E402
from helio_jax.workflows.scene_file import SceneFile, load_scene  # noqa: E402
from helio_jax.workflows.truth import true_surface  # noqa: E402

STEEP = math.cos(math.radians(20.0))
"""Normals whose z is below this are those of steep parts."""
LIMIT, SMALL = 0.05, 0.002
"""Largest error that counts as right: share of the multiple scattering, or of the signal of a level substrate."""
PATHS = 4_000_000
"""Paths of a prediction."""
BALL = {"kind": "spheres", "spheres": [{"radius_um": 120.0, "cap_height_um": 120.0, "center_um": [10.0, -25.0]}]}


def shapes(size: int) -> dict[str, SceneFile]:
    """Make the scenes of named shapes, on rasters of about so many pixels a side."""

    def coarse(name: str) -> SceneFile:
        path = ROOT / "scenes" / f"{name}.toml"
        scan = load_scene(path).scan
        pitch = scan.pixel_size_um * scan.nx / size
        return load_scene(path, {"scan.nx": size, "scan.ny": size, "scan.pixel_size_um": pitch})

    def on_substrate(sample: dict[str, Any], pitch: float) -> SceneFile:
        scene = load_scene(ROOT / "scenes" / "sphere_a.toml")
        tables = scene.instrument.model_dump(mode="json", exclude_none=True, exclude={"uncertainty"})
        scan = {"nx": size, "ny": size, "pixel_size_um": pitch, "pitch": "sample"}
        return SceneFile.model_validate(tables | {"sample": {"size_um": 16000.0} | sample, "scan": scan})

    return {
        "pyramid": on_substrate(PYRAMID | {"azimuth_deg": 20.0}, PYRAMID_PITCH * 41 / size),
        "half ball": on_substrate(BALL, 12.0 * 41 / size),
        "sphere_a": coarse("sphere_a"),
        "sphere_b": coarse("sphere_b"),
    }


def random_scenes(families: list[str], numbers: range, seed: int, size: int) -> Iterator[tuple[str, SceneFile]]:
    """Draw members of families (`benchmarks/shapes.py`)."""
    for family in families:
        for member in members(family, seed, numbers, (size, size)):
            with tempfile.TemporaryDirectory() as folder:
                scene = load_scene(member.write(Path(folder)))
                yield f"{member.name}, {member.about['kind']}", scene


def regions(normals: np.ndarray) -> dict[str, np.ndarray]:
    """Divide the pixels by their distance from steep parts; regions of fewer than 4 pixels are left out."""
    is_steep = normals[..., 2] < STEEP
    away = np.asarray(distance_transform_edt(~is_steep)) if is_steep.any() else np.full(is_steep.shape, np.inf)
    found = {"steep": is_steep, "1-3": (away >= 1.0) & (away <= 3.0), "3-9": (away > 3.0) & (away <= 9.0)}
    return {name: region for name, region in found.items() if region.sum() > 3}


def run(name: str, scene: SceneFile, rays: int, paths: int, seed: int) -> Row:
    """Trace a scene, predict its multiple scattering from the true heights, and compare."""
    started = time.perf_counter()
    stack = pipeline.simulate(scene, rays=rays, seed=seed).only()
    truth = true_surface(scene, stack.x, stack.y)
    assert stack.by_order is not None and stack.n_rays is not None and truth.normals is not None
    settings = scene.reconstruct
    predict = make_predictor(stack, paths, settings.refine.substrate_um, border=settings.border)
    found = predict(truth.height, truth.normals).multiple
    traced = stack.by_order[1:].sum(0) / stack.n_rays
    level = float(np.median(stack.by_order[0] / stack.n_rays))
    of = {
        where: ((found[:, r].mean() / traced[:, r].mean() - 1.0), (found[:, r] - traced[:, r]).mean() / level)
        for where, r in regions(truth.normals).items()
    }
    is_right = all(abs(own) <= LIMIT or abs(signal) <= SMALL for own, signal in of.values())
    said = ", ".join(f"{where} {own:+.1%} ({signal:+.2%})" for where, (own, signal) in of.items()) or "nothing steep"
    shares = {where: {"of_multiple": own, "of_signal": signal} for where, (own, signal) in of.items()}
    seconds = time.perf_counter() - started
    return row(
        "30.2", f"multiple scattering: {name}", said, "5 %, or 0.2 % of signal", is_right, errors=shares, s=seconds
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--shapes", default="pyramid,half ball,sphere_a,sphere_b")
    parser.add_argument("--families", default="smooth,free,mesa,overhang")
    parser.add_argument("--members", type=int, default=3)
    parser.add_argument("--rays", type=int, default=1024)
    parser.add_argument("--size", type=int, default=41)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--tiny", action="store_true")
    given = parser.parse_args()
    paths = PATHS
    if given.tiny:
        given.shapes, given.families, given.members = "pyramid", "smooth", 1
        given.rays, given.size, paths = 16, 17, 50_000
    wanted = [name for name in given.shapes.split(",") if name]
    known = shapes(given.size)
    if unknown := set(wanted) - set(known):
        parser.error(f"unknown shapes {', '.join(sorted(unknown))}: choose of {', '.join(known)}")
    scenes = [(name, known[name]) for name in wanted]
    families = [name for name in given.families.split(",") if name]
    rows: list[Any] = []
    drawn = random_scenes(families, range(given.members), given.seed, given.size)
    for name, scene in chain(scenes, drawn):
        rows.append(run(name, scene, given.rays, paths, given.seed))
        write(given.output / "multiple.json", rows, given.seed)


if __name__ == "__main__":
    main()
