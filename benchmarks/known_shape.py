"""What geometry a measured sphere asks for whose shape is known: the instrument by a standard, not by a reconstruction.

python benchmarks/known_shape.py STACK.h5 SCENE.toml [--hold incidence,...]   (no stack: a sphere of our own)

Incidence, polar angle of every aperture, distance and the sphere's place are fitted to the micrographs, with gain,
offset and drift as `helio compare` has them, by least squares with Cauchy's weights: a foot that is unlike the scene's
shall not decide. Printed with error bars (of the counts, scaled to the residuals left; the simulation's own noise is
not in them, which makes a sphere of our own 4 of them wrong with 64 rays), chi-square per pixel, and from the median
residual (robust). Held at what the scene says: what is named after --hold.

The truth goes into it: whoever reconstructs the same sphere with this geometry scores nothing. It tells what in a
reconstruction comes from the stated geometry, and may serve for other samples in the same instrument.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import rows  # noqa: E402
from helio_jax.arrays import pitch, robust_std  # noqa: E402
from helio_jax.formats.hdf5 import read_stack  # noqa: E402
from helio_jax.inverse.linear import signal_of  # noqa: E402
from helio_jax.micrograph import MicrographStack  # noqa: E402
from helio_jax.scores.agreement import find_shift, normalise  # noqa: E402
from helio_jax.workflows import pipeline  # noqa: E402
from helio_jax.workflows.compare import raster_of  # noqa: E402
from helio_jax.workflows.scene_file import SceneFile, load_scene  # noqa: E402

STEP_DEG, STEP_UM = 1.0, 100.0
"""Steps of the derivatives; places by a quarter of a pixel."""
OUTLIER = 3.0
"""Residuals, in robust standard deviations, from which on they count less (Cauchy)."""
INCIDENCE, POLAR, FARTHER = 24.0, (3.0, -2.0, 1.0), -200.0
"""The sphere of our own: incidence [deg]; polar angles [deg] and distance [um] more than the scene's."""


def changed(scene: SceneFile, polar: np.ndarray, distance: float) -> dict[str, Any]:
    """Return the settings of apertures whose polar angles are larger by so much [deg], the sample so far away [um]."""
    aim = np.stack([np.radians(polar), np.zeros(len(polar))], 1)
    moved = scene.moved(aim, 0.0)
    centers: dict[str, Any] = {
        f"detector.{k}.center_um": list(map(float, d.center_um or ())) for k, d in enumerate(moved.detector)
    }
    return centers | {"plate.sample_distance_um": float(distance)}


class KnownShape:
    """Micrographs, the scene that they are of, and which of its geometry is fitted."""

    def __init__(self, stack: MicrographStack, path: Path, rays: int, held: list[str]) -> None:
        self.stack, self.path, self.scene = stack, path, load_scene(path)
        self.rays = rays
        polar = [f"polar {name}" for name in self.scene.detector_names]
        self.names = ["incidence", *polar, "distance", "place x", "place y"]
        quarter = 0.25 * pitch(stack.y)
        self.steps = np.array([STEP_DEG, *(STEP_DEG,) * len(polar), STEP_UM, quarter, quarter])
        start = [self.scene.beam.incidence_deg, *(0.0,) * len(polar), self.scene.sample_distance]
        self.start = np.array([*start, *find_shift(stack, self.simulated(np.array([*start, 0.0, 0.0]))[0])])
        self.free = np.array([not any(name.startswith(h) for h in held) for name in self.names])

    def simulated(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return detection probabilities and their variance, for values of all that is named."""
        incidence, *polar, distance, x, y = at
        changes = raster_of(self.stack, self.scene, (x, y)) | changed(self.scene, np.array(polar), distance)
        changes |= {"beam.incidence_deg": float(incidence), "trace.rays": self.rays}
        return signal_of(pipeline.simulate(load_scene(self.path, changes), maps=False).only())

    def residuals(self, at: np.ndarray) -> np.ndarray:
        """Return (measured - simulated) / standard deviation of all observed pixels, gain and background fitted."""
        image, variance = self.simulated(at)
        found = normalise(self.stack, image, own_variance=variance).residuals
        return np.where(self.stack.is_observed, found, 0.0).ravel()

    def fit(self, typical: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the values of all that is named, their standard deviations (0: held), and the residuals there.

        Args:
            typical: residual at the start; from `OUTLIER` times it on they count less.
        """

        def residuals(scaled: np.ndarray) -> np.ndarray:
            at = self.start.copy()
            at[self.free] += scaled * self.steps[self.free]
            return self.residuals(at)

        def derivatives(
            scaled: np.ndarray,
        ) -> np.ndarray:  # over a whole step each way: shorter ones drown in ray noise
            return np.stack(
                [0.5 * (residuals(scaled + way) - residuals(scaled - way)) for way in np.eye(scaled.size)], 1
            )

        found = least_squares(
            residuals,
            np.zeros(self.free.sum()),
            derivatives,  # type: ignore[arg-type]  # SciPy's stubs know texts only
            loss="cauchy",
            f_scale=OUTLIER * typical,
            xtol=1e-3,
            ftol=1e-4,
            max_nfev=20,
        )
        weight = 1.0 / (1.0 + (found.fun / (OUTLIER * typical)) ** 2)
        spread = np.sum(weight * found.fun**2) / np.sum(weight)
        covariance = spread * np.linalg.inv(found.jac.T @ found.jac)  # found.jac: weighted by the loss
        values, std = self.start.copy(), np.zeros(len(self.names))
        values[self.free] += found.x * self.steps[self.free]
        std[self.free] = np.sqrt(np.diag(covariance)) * self.steps[self.free]
        return values, std, found.fun


def our_own(path: Path, rays: int, size: int) -> MicrographStack:
    """Return a noisy scan of the scene by an instrument that differs from the stated one."""
    scene = load_scene(path)
    nominal = scene.scan.model_dump()
    polar, distance = np.array(POLAR), scene.sample_distance + FARTHER
    changes = {"beam.incidence_deg": INCIDENCE, "trace.rays": rays, "trace.seed": 5, "scan.nx": size}
    changes |= {"scan.ny": size, "scan.pixel_size_um": nominal["pixel_size_um"] * nominal["nx"] / size}
    stack = pipeline.simulate(load_scene(path, changes | changed(scene, polar, distance)), maps=False).only()
    assert stack.n_rays is not None
    level = 3000.0 / np.median(stack.counts, axis=(1, 2), keepdims=True)
    counts = np.random.default_rng(7).poisson(level * stack.counts + 5000.0).astype(float)
    return stack.replace(counts=counts, variance=np.maximum(counts, 1.0), background=None, n_rays=None, by_order=None)


def main() -> None:
    """Fit and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stack", type=Path, nargs="?")
    parser.add_argument("scene", type=Path, nargs="?", default=ROOT / "scenes" / "measured_sphere_a.toml")
    parser.add_argument("--hold", default="", help="e.g. incidence,distance")
    parser.add_argument("--rays", type=int, default=64)
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--tiny", action="store_true", help="a sphere of our own, few rays and pixels")
    args = parser.parse_args()
    rays = 16 if args.tiny else args.rays
    is_own = args.tiny or args.stack is None
    if is_own:
        stack = our_own(args.scene, rays, 61 if args.tiny else 121)
    else:
        stack = read_stack(str(args.stack))
    known = KnownShape(stack, args.scene, rays, [name for name in args.hold.split(",") if name])
    names = known.names[:-2]  # without the place
    true = dict(zip(names, [INCIDENCE, *POLAR, known.scene.sample_distance + FARTHER], strict=True)) if is_own else {}
    before = known.residuals(known.start)
    values, std, after = known.fit(float(robust_std(before)))
    done = []
    for name, stated, value, error in zip(known.names, known.start, values, std, strict=True):
        unit = "um" if name.startswith(("dist", "place")) else "deg"
        aim = f"{true[name]:.1f} {unit}" if name in true else f"start {stated:.1f} {unit}"
        is_reached = bool(abs(value - true[name]) <= 4.0 * max(error, 0.1)) if name in true else None
        done.append(rows.row("shape", name, f"{value:.2f} +- {error:.2f} {unit}", aim, is_reached))
    for when, r in (("as stated", before), ("as fitted", after)):
        text = f"chi-square per pixel {np.mean(r**2):.2f}, robust one {robust_std(r) ** 2:.2f}"
        done.append(rows.row("shape", f"{stack.name}, geometry {when}", text, "1", None))
    rows.write(args.output / ("known_shape_tiny.json" if args.tiny else "known_shape.json"), done, 5)


if __name__ == "__main__":
    main()
