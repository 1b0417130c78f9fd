"""How well heights survive an instrument that is not what it says: simulated scans with a real instrument's faults.

python benchmarks/calibration.py [--output benchmarks/out] [--size N] [--cases sphere_a,sphere_b,...] [--tiny]

Each scan: background 65 % of the reading, gains that differ by more than 2, drift along the lines and in time, offsets
of scan lines, Poisson noise; apertures aimed up to one prior deviation elsewhere than stated. The stack that is
calibrated and fitted, both with default settings, knows the stated instrument only. Truth scores, and nothing else.

--transfer: the geometry fitted to sphere A is frozen in an instrument file; the micrographs of sphere B, recorded by
the same faulty instrument with other drift and noise, are predicted with it, gain, offset and drift fitted: chi-square
per pixel, beside that of the stated instrument and of the true one.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import rows  # noqa: E402
from helio_jax.formats.toml import write_instrument  # noqa: E402
from helio_jax.instrument import Instrument, Uncertainty  # noqa: E402
from helio_jax.micrograph import MicrographStack  # noqa: E402
from helio_jax.workflows import pipeline  # noqa: E402
from helio_jax.workflows.compare import compare  # noqa: E402
from helio_jax.workflows.scene_file import SceneFile, load_instrument, load_scene  # noqa: E402

SIGNALS = 3450.0, 2690.0, 1520.0
"""Mean counts of the flat that come from the sample, as on the measured sphere A."""
BACKGROUND_SHARE = 0.65
SURE = Uncertainty(polar_deg=5.0, azimuth_deg=3.0)
"""What the stated instrument says of itself."""


def recorded(scene: SceneFile, seed: int) -> tuple[MicrographStack, np.ndarray]:
    """Return the scan as the faulty instrument records it, told as the stated one, and its aims [detector, 2], deg.

    The apertures are aimed within one prior deviation of where they are stated.
    """
    rng = np.random.default_rng([seed, 0xFA17])
    aim = np.array([SURE.polar_deg, SURE.azimuth_deg]) * rng.uniform(-1.0, 1.0, (len(scene.detector), 2))
    misaimed = scene.model_copy(update={"detector": scene.moved(np.radians(aim), 0.0).detector})
    stack = pipeline.simulate(misaimed, rays=64, seed=seed).only()
    instrument = scene.moved(np.zeros((3, 2)), 0.0).model_copy(update={"uncertainty": SURE})
    return read_by(stack.counts, stack, instrument, rng), aim


def read_by(
    counts: np.ndarray, stack: MicrographStack, instrument: Instrument, rng: np.random.Generator
) -> MicrographStack:
    """Return counts [detector, y, x] as unlike gains, background, drift, scan lines and noise leave them to be read.

    Args:
        counts: expected from the sample, in any unit.
        stack: whose raster and name they have.
        instrument: what is told of it.
        rng: of drift, lines and noise.
    """
    signal = np.array(SIGNALS)[:, None, None]
    counts = counts / np.median(counts, axis=(1, 2), keepdims=True) * signal
    lines, along = np.linspace(-1.0, 1.0, stack.shape[2]), np.linspace(-1.0, 1.0, stack.shape[1])[:, None]
    background = signal * BACKGROUND_SHARE / (1.0 - BACKGROUND_SHARE)
    waves = [np.cos(np.pi * (i * lines + rng.uniform(0, 2))) for i in (0.5, 1.0)]
    drift = (
        sum(0.1 * rng.normal(size=(3, 1, 1)) * wave for wave in waves) + 0.07 * rng.normal(size=(3, 1, 1)) * along**2
    )
    offsets = 0.02 * rng.normal(size=(3, 1, lines.size))
    mean = counts + background + signal * (drift + offsets)
    return MicrographStack(
        rng.poisson(mean).astype(float),
        stack.x,
        stack.y,
        instrument,
        variance=mean,
        fast_axis="y",
        noise="measured",
        name=stack.name,
    )


def sized(case: str, size: int) -> SceneFile:
    """Return a scene on a raster of size x size pixels."""
    field = {"sphere_a": 3630.0, "sphere_b": 3630.0}.get(case)
    scene = load_scene(ROOT / "scenes" / f"{case}.toml")
    pixel = (field or scene.scan.nx * scene.scan.pixel_size_um) / size
    return load_scene(ROOT / "scenes" / f"{case}.toml", {"scan.nx": size, "scan.ny": size, "scan.pixel_size_um": pixel})


def study(case: str, size: int, seed: int, settings: dict) -> rows.Row:
    """Fit one faulty scan and score it."""
    scene = sized(case, size)
    began = time.perf_counter()
    stack, aim = recorded(scene, seed)
    rec = pipeline.reconstruct(stack, "refine", refine=settings)
    truth = pipeline.true_height(scene, rec)
    top = np.unravel_index(np.argmax(truth.height), truth.height.shape)
    value, std = rec.spread(lambda h: float(h[top] - np.median(h)))
    error = value - float(truth.height[top])
    scores = pipeline.evaluate(rec, truth)
    text = f"top {value:.0f} +- {std:.1f} um, true {truth.height[top]:.0f}; RMS image {100 * scores.rms_image:.1f} %"
    return rows.row(
        case, f"{size} x {size}, faulty instrument", text, "error <= 3 stated sd", bool(abs(error) <= 3 * std),
        error_um=error, std_um=std, seconds=time.perf_counter() - began, scores=scores.as_dict(),
        true_aim_deg=aim.tolist(), instrument=dict(rec.provenance["instrument"]), status=rec.status,
    )  # fmt: skip


def _apertures(instrument: Instrument) -> dict:
    """Return the overrides that give a scene an instrument's apertures."""
    out = {}
    for k, a in enumerate(instrument.apertures()):
        out |= {f"detector.{k}.center_um": list(a.center), f"detector.{k}.axes_um": [2.0 * v for v in a.semi_axes]}
        out |= {f"detector.{k}.rotation_deg": float(np.degrees(np.arctan2(np.sin(a.rotation), np.cos(a.rotation))))}
    return out


def transfer(size: int, seed: int, settings: dict, folder: Path) -> rows.Row:
    """Calibrate on sphere A, predict sphere B."""
    first, second = sized("sphere_a", size), sized("sphere_b", size)
    began = time.perf_counter()
    stack, aim = recorded(first, seed)
    rec = pipeline.reconstruct(stack, "refine", refine=settings)
    file = folder / "calibrated.toml"
    write_instrument(rec, file)
    seen, _ = recorded(second, seed)  # the same faults of the plate, for they are drawn first
    known = {
        "stated": stack.instrument,
        "calibrated": load_instrument(file),
        "true": second.moved(np.radians(aim), 0.0),
    }
    chi2 = {}
    for name, instrument in known.items():
        found = compare(seen, ROOT / "scenes" / "sphere_b.toml", overrides=_apertures(instrument) | {"trace.rays": 16})
        chi2[name] = [float(np.mean(v)) for v in (found.agreement.chi2, found.agreement.chi2_unflagged)]
    text = ", ".join(f"{name} {all_:.2f} ({clean:.2f} unflagged)" for name, (all_, clean) in chi2.items())
    return rows.row(
        "transfer", f"{size} x {size}, A to B", f"chi-square per pixel: {text}", "calibrated <= 2 unflagged",
        bool(chi2["calibrated"][1] <= 2.0), chi2=chi2, seconds=time.perf_counter() - began, seed=seed,
        true_aim_deg=aim.tolist(), instrument=dict(rec.provenance["instrument"]),
    )  # fmt: skip


def main() -> None:
    """Run the cases and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--cases", default="sphere_a,sphere_b,two_spheres,pyramid")
    parser.add_argument("--size", type=int, default=81)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--tiny", action="store_true")
    parser.add_argument("--transfer", action="store_true", help="calibrate on sphere A, predict sphere B")
    args = parser.parse_args()
    tiny = {"max_rounds": 1, "fixed_rounds": 0, "photometric_rounds": 1, "cg_steps": 10, "rays": 10_000, "samples": 4}
    settings = tiny if args.tiny else {}
    cases = ["sphere_a"] if args.tiny else args.cases.split(",")
    args.output.mkdir(parents=True, exist_ok=True)
    if args.transfer:
        done = [transfer(16 if args.tiny else args.size, args.seed, settings, args.output)]
        rows.write(args.output / ("transfer_tiny.json" if args.tiny else "transfer.json"), done, args.seed)
        return
    done = [study(case, 16 if args.tiny else args.size, args.seed, settings) for case in cases]
    rows.write(args.output / ("calibration_tiny.json" if args.tiny else "calibration.json"), done, args.seed)


if __name__ == "__main__":
    main()
