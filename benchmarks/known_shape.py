"""Calibration by known shapes: are the instruments found, within the stated errors? On twins made by the tracer.

python benchmarks/known_shape.py [--instruments N] [--first SEED] [--pixels N] [--tiny]
python benchmarks/known_shape.py --then-refine      (then heights of another sample, by the calibrated instrument)
python benchmarks/known_shape.py --collect          (rows over all twins in the output folder so far)

A twin is a scan of a ball of known radius whose burial is not known, traced (`hx.simulate`, never `hx.render`) by an
instrument drawn at random: plate shift up to 0.25 D, rotation +-2 deg, scale +-5 %, distance +-10 %, tilt +-3 deg,
incidence +-1 deg, gains x0.5 to x2, offsets 1 to 3 times the signal, albedo ratio 0.85 to 1.1, scattering by
cos^(1 + m) with m from -0.1 to 0.2. To the counts come noise (the substrate's signal is 25 times that of one pixel), a
pedestal over the stage, drift and offsets of scan lines. The fit is told the instrument as stated, the ball's radius
and the variance of the noise, nothing else. Printed: root mean square of the pulls (value - true) / stated s.d. of all
parameters that the scans determine, chi-square per pixel.

With `--then-refine` a pyramid is traced with the same drawn instrument, untilted, as another scan of the campaign: the
same gains, offsets, pedestal and scattering law, at another place of the stage, with drift, offsets of scan lines and
noise of its own.
`hx.reconstruct` makes heights of it by the calibrated instrument, and for comparison without its read-out, and by the
instrument as stated.
"""

import argparse
import json
import math
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import helio_jax as hx  # noqa: E402
from benchmarks import rows  # noqa: E402
from helio_jax.calibration.known_objects import KnownObject  # noqa: E402
from helio_jax.calibration.known_report import as_record, calibrated_instrument  # noqa: E402
from helio_jax.calibration.unknowns import OBJECT  # noqa: E402
from helio_jax.errors import GuardError  # noqa: E402
from helio_jax.forward.form_factor import substrate_signal  # noqa: E402
from helio_jax.forward.optics import Optics  # noqa: E402
from helio_jax.forward.readout import pedestal_modes  # noqa: E402
from helio_jax.instrument import Instrument  # noqa: E402
from helio_jax.workflows.calibrate_known import calibrate_known  # noqa: E402
from helio_jax.workflows.known_scene import known_scene  # noqa: E402
from helio_jax.workflows.scene_file import SceneFile  # noqa: E402

RADIUS, FIELD, SUBSTRATE = 1000.0, 3630.0, 8000.0
SNR, SIGNAL = 25.0, 3000.0
PEDESTAL, DRIFT, LINES = 0.05, 0.03, 0.01
"""Pedestal, drift and offsets of scan lines over the signal."""
TWIN_RAYS = 2048
"""Paths per pixel: their noise adds 2 to 6 % to the stated variance."""
KNOWN = "ball radius=1000"
PYRAMID = {"kind": "pyramid", "size_um": SUBSTRATE, "base_um": 700.0, "top_um": 300.0, "height_um": 140.0}
PYRAMID_PITCH = 30.0
REACH = 0.3 * FIELD
"""Largest distance of its scan from the ball's on the stage, along each axis [um]."""
N_PEDESTAL = 9
"""Shapes of a cubic pedestal."""
INSTRUMENTS: tuple[str, ...] = "calibrated", "without read-out", "as stated"


def draw(seed: int, stated: Instrument) -> tuple[Instrument, dict[str, float]]:
    """Draw an instrument, and the truth by the names of the report, degrees and um."""
    rng, distance = np.random.default_rng(seed), stated.sample_distance
    angle, length = rng.uniform(0.0, 2.0 * np.pi), 0.25 * distance * math.sqrt(rng.uniform())
    low = {"plate scale": 0.95, "sample distance": 0.9, "plate rotation": -2.0, "incidence": -1.0, "tilt": -3.0}
    scale, far = (rng.uniform(low[name], 2.0 - low[name]) for name in ("plate scale", "sample distance"))
    rotation, incidence = (rng.uniform(low[name], -low[name]) for name in ("plate rotation", "incidence"))
    tilt = rng.uniform(low["tilt"], -low["tilt"], 2)
    shift = length * math.cos(angle), length * math.sin(angle)
    true = stated.moved(
        np.zeros((len(stated.detector), 2)), (far - 1.0) * distance, plate_shift=shift, scale=scale,
        rotation=math.radians(rotation), incidence=math.radians(incidence),
    )  # fmt: skip
    ratio = rng.uniform(0.85, 1.1)
    truth = {
        "plate shift x": shift[0], "plate shift y": shift[1], "plate scale": scale, "plate rotation": rotation,
        "sample distance": far * distance, "incidence": true.beam.incidence_deg, "tilt x": tilt[0], "tilt y": tilt[1],
        "object x": rng.uniform(-150.0, 150.0), "object y": rng.uniform(-150.0, 150.0),
        "height": rng.uniform(630.0, 740.0), "log albedo ratio": math.log(ratio),
        "exponent": np.random.default_rng([seed, 17]).uniform(-0.1, 0.2),
        # the tracer's brighter surface has the albedo 1, the fit's substrate
        "log multiple scattering": -max(0.0, math.log(ratio)),
    }  # fmt: skip
    return true, truth


def scan(seed: int, size: int, rays: int) -> tuple[hx.MicrographStack, dict[str, float]]:
    """Trace and read out the twin of a seed; its stack states the instrument that the fit is told."""
    stated = hx.load_scene(str(ROOT / "scenes" / "measured_sphere_a.toml")).instrument
    true, truth = draw(seed, stated)
    numbers = dict.fromkeys(OBJECT, 0.0) | {"radius": RADIUS} | {k: v for k, v in truth.items() if k in OBJECT}
    numbers |= {name: math.radians(truth[name]) for name in ("tilt x", "tilt y")}
    axis = (np.arange(size) - 0.5 * (size - 1)) * FIELD / size
    scene = known_scene(KnownObject.parse(KNOWN), numbers, true, axis, axis, substrate_um=SUBSTRATE)
    return read_out(scene, axis, stated, rays, seed, "poisson", Campaign.draw(seed, true), np.zeros(2)), truth


class Campaign(NamedTuple):
    """What all scans of a campaign share: signal of the substrate, gain, offset, pedestal over the stage."""

    signal: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    pedestal: np.ndarray

    @classmethod
    def draw(cls, seed: int, true: Instrument) -> "Campaign":
        """Draw the read-out of a seed."""
        rng, n = np.random.default_rng([seed, 11]), len(true.detector)
        signal = SIGNAL * 2.0 ** rng.uniform(-1.0, 1.0, n)
        offset = signal * rng.uniform(1.0, 3.0, n)
        pedestal = signal[:, None] * rng.normal(0.0, PEDESTAL, (n, N_PEDESTAL))
        return cls(signal, signal / np.asarray(substrate_signal(Optics.of(true))), offset, pedestal)


def read_out(
    scene: SceneFile,
    axis: np.ndarray,
    stated: Instrument,
    rays: int,
    seed: int,
    noise: str,
    campaign: Campaign,
    stage: np.ndarray,
) -> hx.MicrographStack:
    """Trace a scene; return what real detectors would read, the variance known where the noise is "poisson"."""
    size = axis.size
    beam = scene.beam.model_copy(update={"source": "uniform"})  # a spot of finite size, which the fit does not know
    traced = hx.simulate(scene.model_copy(update={"beam": beam}), rays=rays, seed=seed + 1, maps=False).only()
    assert traced.n_rays
    probability = traced.counts.reshape(-1, size, size) / traced.n_rays
    rng, time_of_line = np.random.default_rng([seed, 7]), np.linspace(-1.0, 1.0, size)[:, None]
    u, v = np.meshgrid(*((axis + s) / (0.5 * FIELD) for s in stage))
    modes, images, variance = pedestal_modes(u, v, 3)[0], [], []
    for image, signal, gain, offset, pedestal in zip(probability, *campaign, strict=True):
        reading = gain * image + offset + np.tensordot(pedestal, modes, 1)
        reading += DRIFT * signal * np.sin(2.5 * time_of_line + rng.uniform(0.0, 2.0 * np.pi))
        reading += rng.normal(0.0, LINES * signal, (size, 1))
        images.append(reading + rng.normal(0.0, signal / SNR, image.shape))
        variance.append(np.full(image.shape, (signal / SNR) ** 2))
    known = np.array(variance) if noise == "poisson" else None
    about = {"variance": known, "noise": noise, "name": f"twin {seed}", "stage_position": np.append(stage, 0.0)}
    return hx.MicrographStack(np.array(images), axis, axis, stated, **about)


def heights(seed: int, size: int, rays: int, instruments: dict[str, Instrument]) -> dict[str, dict[str, float | None]]:
    """Refine a pyramid that the drawn instrument of a seed has scanned, by each of some instruments."""
    true, truth = draw(seed, hx.load_scene(str(ROOT / "scenes" / "measured_sphere_a.toml")).instrument)
    axis = (np.arange(size) - 0.5 * (size - 1)) * PYRAMID_PITCH
    tables = true.idealised().model_dump(mode="json", exclude_none=True, exclude={"uncertainty"})
    tables |= {"name": "pyramid", "sample": PYRAMID | {"azimuth_deg": 20.0, "material": "own"}}
    tables["material"] = {"own": {"kind": "power", "exponent": truth["exponent"]}}
    tables["scan"] = {"nx": size, "ny": size, "pixel_size_um": PYRAMID_PITCH, "pitch": "sample"}
    reach = 0.75 * PYRAMID["base_um"]
    region = {"region_radius_um": reach, "substrate_radius_um": reach, "height_um": PYRAMID["height_um"]}
    scene, out = SceneFile.model_validate(tables | {"truth": region}), {}
    points = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2).tolist()
    as_list = SceneFile.model_validate(tables | {"scan": {"kind": "list", "points_um": points}})
    campaign = Campaign.draw(seed, true)
    stage = np.random.default_rng([seed, 13]).uniform(-REACH, REACH, 2)
    for name, instrument in instruments.items():
        try:
            stack = read_out(as_list, axis, instrument, rays, seed + 5000, "measured", campaign, stage)
            rec = hx.reconstruct(stack, method="refine")
        except GuardError as e:
            print(f"twin {seed}, instrument {name}: refused: {e}")
            continue
        score = hx.evaluate(rec, hx.true_height(scene, rec))
        wanted = "recovered_height", "rms_region", "pull_mean", "pull_std", "coverage_1", "coverage_2", "valid_fraction"
        out[name] = {key: getattr(score, key) for key in wanted}
    return out


def evaluate(seed: int, size: int, twin_rays: int, then_refine: bool, **changes: Any) -> dict[str, Any]:
    """Calibrate on the twin of a seed: pulls of all parameters, which are determined, chi-square; then heights."""
    stack, truth = scan(seed, size, twin_rays)
    begin = time.time()
    fit = calibrate_known([stack], [KNOWN], **changes)
    record = as_record(fit)
    pulls = {r["name"]: (r["value"] - truth.get(r["name"], 0.0)) / r["std"] for r in record["table"]}
    determined = [r["name"] for r in record["table"] if r["is_determined"]]
    about = {name: record[name] for name in ("chi_square", "robust_chi_square", "inflation", "is_converged", "rounds")}
    about |= {"seed": seed, "pixels": size, "pulls": pulls, "determined": determined, "s": time.time() - begin}
    if then_refine:
        calibrated = calibrated_instrument(fit)
        without = calibrated.model_copy(update={"readout": None})
        instruments = dict(zip(INSTRUMENTS, (calibrated, without, fit.stated), strict=True))
        about["heights"] = heights(seed, size, twin_rays, instruments)
    return about


def collect(found: list[dict[str, Any]]) -> list[rows.Row]:
    """Tabulate the pulls of the parameters that most twins determine, and chi-square."""
    out = []
    for name in found[0]["pulls"]:
        pulls = np.array([f["pulls"][name] for f in found if name in f["determined"]])
        if 2 * len(pulls) >= len(found):
            size = float(np.sqrt(np.mean(pulls**2)))
            text = f"rms {size:.2f}, mean {pulls.mean():+.2f}, largest {np.abs(pulls).max():.1f}, {len(pulls)} twins"
            out.append(rows.row("1", f"pulls of {name}", text, "0.8 to 1.25", 0.8 <= size <= 1.25))
    chi = np.array([f["chi_square"] for f in found])
    text = f"median {np.median(chi):.3f}, {chi.min():.3f} to {chi.max():.3f}, {len(chi)} twins"
    out.append(rows.row("1", "chi-square per pixel", text, "0.95 to 1.1", bool(0.95 <= np.median(chi) <= 1.1)))
    lost = [f["seed"] for f in found if not f["is_converged"]]
    out.append(rows.row("1", "fits that have not converged", f"{len(lost)} of {len(found)} {lost}", "0", not lost))
    for name in INSTRUMENTS:
        of = [f["heights"][name] for f in found if name in f.get("heights", {})]
        refused = sum("heights" in f for f in found) - len(of)
        if refused:
            out.append(rows.row("2", f"pyramids refused, instrument {name}", f"{refused}", "0", False))
        if not of:
            continue
        error, pull, one, two = (
            np.array([np.nan if h[key] is None else h[key] for h in of])
            for key in ("recovered_height", "pull_std", "coverage_1", "coverage_2")
        )
        error, size = np.abs(error - 1.0), np.sqrt(pull**2 + np.array([h["pull_mean"] for h in of]) ** 2)
        text = f"median {np.median(error):.1%}, worst {error.max():.1%}, {len(of)} twins"
        reached = bool(np.median(error) <= 0.01 and error.max() <= 0.04)
        out.append(rows.row("2", f"height of a pyramid, instrument {name}", text, "median 1 %, worst 4 %", reached))
        text = f"median {np.median(size):.2f}, largest {size.max():.2f}"
        inside = bool(0.8 <= np.median(size) <= 1.25)
        out.append(rows.row("2", "  pulls of its heights, root mean square", text, "0.8 to 1.25", inside))
        text = f"mean {one.mean():.0%}, {two.mean():.0%}"
        out.append(
            rows.row("2", "  heights within 1 and 2 s.d.", text, "58 to 78 %, -", bool(0.58 <= one.mean() <= 0.78))
        )
    seconds = float(np.median([f["s"] for f in found]))
    out.append(rows.row("1", "time of a fit, compilation included", f"median {seconds:.0f} s", "-", None))
    return out


def main() -> None:
    """Make twins, calibrate, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instruments", type=int, default=20)
    parser.add_argument("--first", type=int, default=100, help="seed of the first twin")
    parser.add_argument("--pixels", type=int, default=41)
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--then-refine", action="store_true", help="then reconstruct another sample")
    parser.add_argument("--collect", action="store_true", help="only tabulate what is there")
    parser.add_argument("--tiny", action="store_true", help="one twin, few rays and pixels")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    name = "known_shape_tiny" if args.tiny else "known_shape"
    if not args.collect:
        n, size, rays = (1, 17, 64) if args.tiny else (args.instruments, args.pixels, TWIN_RAYS)
        changes = {"max_rounds": 2, "rays": 32, "drift_degree": 3} if args.tiny else {}
        for seed in range(args.first, args.first + n):
            found = evaluate(seed, size, rays, args.then_refine, **changes)
            (args.output / f"{name}_twin_{seed}.json").write_text(json.dumps(found))
            print(f"twin {seed}: chi-square {found['chi_square']:.3f}, {found['rounds']} rounds, {found['s']:.0f} s")
    files = sorted(args.output.glob(f"{name}_twin_*.json"))
    rows.write(args.output / f"{name}.json", collect([json.loads(f.read_text()) for f in files]), args.first)


if __name__ == "__main__":
    main()
