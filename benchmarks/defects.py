"""What of the model's errors heights survive: own spheres with one defect each that the measured sphere A may have.

python benchmarks/defects.py [--output benchmarks/out] [--size 61] [--defects none,plate,...] [--scene SCENE.toml]
    [--tiny]

Each scan is read as in `calibration.py` (unlike gains, background, drift, lines, noise), with an instrument whose
plate, reflectivity, law of scattering or multiple scattering is not what the fit takes it for; then `nearfield` and
`refine`, both with default settings, which know nothing of the defect. A row: height, RMS and shape error of the sphere
(its centre fitted, as on measured data), and the stated deviation. Truth scores, and nothing else. Nothing has to be
reached: the rows tell which errors of the model `refine` does not survive, and whether its error bars say so.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import rows  # noqa: E402
from benchmarks.calibration import read_by  # noqa: E402
from helio_jax.micrograph import MicrographStack  # noqa: E402
from helio_jax.workflows import pipeline  # noqa: E402
from helio_jax.workflows.scene_file import load_scene  # noqa: E402
from helio_jax.workflows.truth import load_truth, true_surface  # noqa: E402

SIDE_UM = 3660.0
PLATE = 4.0 / 3.0
"""Real apertures over stated ones, in place and size: what they are if the measured scans' plate is that of 4 mm."""
BALL = 1.0, 0.93, 0.89
"""How the ball reflects into each detector, relative to the ground: about what the measured sphere A wants."""
FOOT_UM = 50.0
"""Reach of the light that is added about the foot, over which it falls to 1/e."""
LOBE = 0.1, 30.0
"""Share of the atoms that do not leave by the cosine law, and the width (s.d.) of the lobe that they leave in, deg."""

Change = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""(single, multiple [detector, y, x], is on the sphere, distance from its foot um [y, x]) -> single, multiple."""


def _alike(single, multiple, on, from_foot):
    return single, multiple


def _lit_foot(single, multiple, on, from_foot):
    return single, multiple * (1.0 + np.exp(-from_foot / FOOT_UM))


def _other_ball(single, multiple, on, from_foot):
    return single * np.where(on, np.array(BALL)[:, None, None], 1.0), multiple


def _both(*args):
    return _other_ball(*_lit_foot(*args), *args[2:])


class Defect(NamedTuple):
    """What is not as the fit takes it."""

    words: str
    plate: float = 1.0
    """Real apertures over stated ones, in place and size."""
    change: Change = _alike
    """What is done to the images."""
    law: dict[str, object] = {}
    """How ball and ground scatter, as `[material.NAME]` of a scene; empty: by the cosine law."""


def _lobe(kind: str) -> Defect:
    law = {"kind": kind, "sigma_deg": LOBE[1], "diffuse_fraction": 1.0 - LOBE[0]}
    return Defect(f"{LOBE[0]:.0%} of the atoms in a {kind.replace('_', ' ')} lobe of {LOBE[1]:g} deg", law=law)


DEFECTS = {
    "none": Defect("as the fit takes it"),
    "plate": Defect(f"apertures {PLATE:.2f} times as far out and as large", PLATE),
    "foot": Defect("multiple scattering twice as bright at the foot", change=_lit_foot),
    "ball": Defect("ball unlike the ground, by detector", change=_other_ball),
    "all": Defect("these three", PLATE, _both),
    "broad_specular": _lobe("broad_specular"),
    "backscattering": _lobe("backscattering"),
}
"""Defects by their names."""


def scan(path: Path, size: int, defect: str, seed: int, rays: int) -> MicrographStack:
    """Return the scan of a scene's sphere that a defect changes, told as if it did not."""
    _, scale, change, law = DEFECTS[defect]
    raster = {"scan.nx": size, "scan.ny": size, "scan.pixel_size_um": SIDE_UM / size, "trace.rays": rays}
    told = load_scene(path, raster)
    real: dict[str, object] = {}
    for k, detector in enumerate(told.model_dump()["detector"]):
        for key in ("center_um", "axes_um"):
            real[f"detector.{k}.{key}"] = [scale * v for v in detector[key]]
    if law:
        real |= {"sample.material": "other", "sample.spheres.0.material": "other"}
        real |= {f"material.other.{key}": value for key, value in law.items()}
    stack = pipeline.simulate(load_scene(path, raster | real), seed=seed, maps=False).only()
    assert stack.by_order is not None  # simulated
    height = true_surface(told, stack.x, stack.y).height
    sphere, (shift_x, shift_y) = told.sample.model_dump()["spheres"][0], told.beam_shift
    foot = float(np.sqrt(sphere["radius_um"] ** 2 - (sphere["radius_um"] - sphere["cap_height_um"]) ** 2))
    grid_x, grid_y = np.meshgrid(stack.x, stack.y)
    from_axis = np.hypot(grid_x - height * shift_x, grid_y - height * shift_y)
    single, multiple = change(stack.by_order[0], stack.by_order[1:].sum(0), height > 0.0, np.abs(from_axis - foot))
    instrument = told.moved(np.zeros((len(told.detector), 2)), 0.0)
    return read_by(single + multiple, stack, instrument, np.random.default_rng(seed))


def study(path: Path, size: int, defect: str, method: str, seed: int, settings: dict, rays: int) -> rows.Row:
    """Reconstruct one scan and score it."""
    began = time.perf_counter()
    rec = pipeline.reconstruct(scan(path, size, defect, seed, rays), method, refine=settings)
    truth = load_truth(path, rec, fit_center=True)
    scores = pipeline.evaluate(rec, truth)
    assert scores.recovered_height is not None and scores.shape_error is not None  # a sphere is scored
    top, std = np.unravel_index(np.argmax(truth.height), truth.height.shape), None
    if rec.height_samples is not None:
        std = 100.0 * rec.spread(lambda h: float(h[top] - np.median(h)))[1] / scores.H_um
    stated = "-" if std is None else f"{std:.1f}"
    value = (
        f"height {100 * scores.recovered_height:.1f} +- {stated} %; RMS {100 * scores.rms_region:.1f}, "
        f"shape {100 * scores.shape_error:.1f} %"
    )
    return rows.row(
        defect, f"{method}, {size} x {size}: {DEFECTS[defect].words}", value, "", None,
        stated_std_percent=std, seconds=time.perf_counter() - began, scores=scores.as_dict(), status=rec.status,
        instrument=dict(rec.provenance.get("instrument", {})),
    )  # fmt: skip


def main() -> None:
    """Run the defects and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--scene", type=Path, default=ROOT / "scenes" / "measured_sphere_a.toml")
    parser.add_argument("--defects", default=",".join(DEFECTS))
    parser.add_argument("--size", type=int, default=61)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--tiny", action="store_true")
    args = parser.parse_args()
    tiny = {"max_rounds": 1, "fixed_rounds": 0, "photometric_rounds": 1, "cg_steps": 10, "rays": 10_000, "samples": 4}
    settings, size, rays = (tiny, 16, 8) if args.tiny else ({}, args.size, 48)
    defects = ["all", "backscattering"] if args.tiny else args.defects.split(",")
    done = [
        study(args.scene, size, defect, method, args.seed, settings, rays)
        for defect in defects
        for method in ("nearfield", "refine")
    ]
    rows.write(args.output / ("defects_tiny.json" if args.tiny else "defects.json"), done, args.seed)


if __name__ == "__main__":
    main()
