"""Ripples of 2 to 3 pixels: three detectors against one in five rotations whose alignment is off by a pixel.

python benchmarks/ripples.py [--output benchmarks/out] [--members N] [--size N] [--seed S] [--tiny]

The heliometric stereo paper says that one detector, whose images come from as many scans, loses such detail by errors
of their alignment. Hills with ripples on them are drawn anew for every member and traced with noise at equal dose. The
number is the share of the ripple's amplitude that is recovered in phase: slopes along the wave vector over the true
ones. `--tiny`: one small member, by `nearfield`.
"""

import argparse
import math
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import RegularGridInterpolator

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import helio_jax as hx  # noqa: E402
from benchmarks.rows import Row, row, write  # noqa: E402
from benchmarks.several_scans import PITCH, displaced  # noqa: E402
from benchmarks.shapes import Member, window  # noqa: E402
from helio_jax.inverse.settings import ReconstructSettings  # noqa: E402
from helio_jax.micrograph import MicrographSet  # noqa: E402
from helio_jax.workflows import pipeline  # noqa: E402
from helio_jax.workflows.scene_file import load_scene  # noqa: E402

ATOMS = 500_000.0
"""Per pixel, of all scans together."""
AZIMUTHS = 90.0, 210.0, 330.0
"""Of the three detectors; the one alone is the first [deg]."""
ROTATIONS = 0.0, 72.0, 144.0, 216.0, 288.0
"""Of the sample below one detector [deg]."""
SLOPE = 0.25
"""Largest slope of the ripples."""
KEPT, LOST = 0.8, 0.5
"""Least share of the amplitude that is kept, largest share that is lost."""


@dataclass(frozen=True)
class Rippled:
    """Hills with a plane wave on them.

    Attributes:
        axis: x and y of the heights, six times finer than the raster [um].
        height: [y, x], um.
        wave: wave vector [1/um].
        reach: distance from the centre beyond which there are no ripples [um].
    """

    axis: np.ndarray
    height: np.ndarray
    wave: np.ndarray
    reach: float

    @classmethod
    def draw(cls, rng: np.random.Generator, n: int) -> "Rippled":
        """Draw hills, and ripples of 2 to 3 pixels in any direction, for a raster of n x n pixels."""
        reach, step = 0.4 * n * PITCH, PITCH / 6.0
        half = math.ceil(1.2 * reach / step)
        axis = step * np.arange(-half, half + 1)
        x, y = np.meshgrid(axis, axis)
        angle, wavelength = rng.uniform(0.0, math.pi), rng.uniform(2.0, 3.0) * PITCH
        wave = 2.0 * math.pi / wavelength * np.array([math.cos(angle), math.sin(angle)])
        hills = np.zeros_like(x)
        for _ in range(4):
            at, width = rng.uniform(-0.5, 0.5, 2) * reach, rng.uniform(0.15, 0.3) * reach
            top = rng.uniform(0.3, 0.6) * width
            hills += top * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2.0 * width**2))
        waves = SLOPE / np.hypot(*wave) * np.cos(wave[0] * x + wave[1] * y + rng.uniform(0.0, 2.0 * math.pi))
        inside = window(x, y, reach)
        return cls(axis, np.sqrt(inside) * hills + inside * waves, wave, reach)

    @property
    def wavelength(self) -> float:
        """In pixels."""
        return 2.0 * math.pi / float(np.hypot(*self.wave)) / PITCH

    def recorded(self, n: int, azimuths: tuple[float, ...], rotations: tuple[float, ...], seed: int) -> MicrographSet:
        """Trace n x n pixels under detectors at some azimuths, the sample rotated; noise of a total dose."""
        top = float(self.height.max())
        aperture = {"polar_deg": 35.0, "half_angle_deg": 6.0}
        raster = {"nx": n, "ny": n, "pixel_size_um": PITCH, "pitch": "sample"}
        tables = {
            "beam": {"incidence_deg": 0.0, "source_size_mrad": 0.1, "pinhole_radius_um": 0.5},
            "plate": {"working_distance_um": 4000.0, "sample_distance_um": 4000.0 + top},
            "detector": [{"name": f"at {a:.0f} deg", "azimuth_deg": a, **aperture} for a in azimuths],
            "scan": raster | {"rotations_deg": list(rotations), "atoms_per_pixel": ATOMS / len(rotations)},
            "sample": {"size_um": 3.0 * n * PITCH, "level_um": 0.0},
            "trace": {"rays": 32, "seed": seed, "maps": False},
            "noise": {"seed": seed},
        }
        with tempfile.TemporaryDirectory() as folder:
            scene = load_scene(Member("ripples", tables, map=(self.axis, self.axis, self.height)).write(Path(folder)))
            return MicrographSet(pipeline.record(scene, pipeline.simulate(scene)).stacks)

    def recovered(self, rec: hx.Reconstruction) -> float:
        """Compute the share of the amplitude that a reconstruction has, in phase."""
        x, y = np.meshgrid(rec.raster_x, rec.raster_y)
        down, along = np.gradient(self.height, self.axis, self.axis)
        slopes = np.stack([along, down], -1)
        true = RegularGridInterpolator((self.axis, self.axis), slopes, "cubic", bounds_error=False, fill_value=0.0)
        weight = window(x, y, self.reach) * np.exp(-1j * (self.wave[0] * x + self.wave[1] * y))
        found = -rec.normals[..., :2] / rec.normals[..., 2:]
        own, whole = (np.nansum(weight[..., None] * s, (0, 1)) @ self.wave for s in (found, true((y, x))))
        return float((own / whole).real)


def rows_of(rng: np.random.Generator, n: int, settings: ReconstructSettings, seed: int) -> list[Row]:
    """Compare three detectors with one, of which the scans are aligned, off by a pixel, or off and then fitted."""
    sample = Rippled.draw(rng, n)
    off = np.vstack([np.zeros(2), rng.normal(0.0, PITCH, (len(ROTATIONS) - 1, 2))])
    three = sample.recorded(n, AZIMUTHS, (0.0,), seed)
    one = sample.recorded(n, AZIMUTHS[:1], ROTATIONS, seed)
    wrong = displaced(one, off)
    fitted, _ = hx.reconstruct_scans(wrong, settings=settings, motions="fitted")
    out = []
    for name, rec, is_kept in (
        ("three detectors", hx.reconstruct(three.stacks[0], settings=settings), True),
        ("one, aligned", hx.reconstruct(one, settings=settings), True),
        ("one, a pixel off", hx.reconstruct(wrong, settings=settings), False),
        ("one, motions fitted", fitted, True),
    ):
        share = sample.recovered(rec)
        target, reached = (f">= {KEPT:.0%}", share >= KEPT) if is_kept else (f"<= {LOST:.0%}", share <= LOST)
        what = f"ripples of {sample.wavelength:.1f} pixels, {name}"
        out.append(row("6", what, f"{share:.0%} of the amplitude", target, reached))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--members", type=int, default=3)
    parser.add_argument("--size", type=int, default=61)
    parser.add_argument("--seed", type=int, default=1127)
    parser.add_argument("--tiny", action="store_true")
    args = parser.parse_args()
    n, members = (21, 1) if args.tiny else (args.size, args.members)
    settings = ReconstructSettings(method="nearfield" if args.tiny else "refine", samples=0)
    rng, rows = np.random.default_rng(args.seed), []
    for number in range(members):
        rows += rows_of(rng, n, settings, args.seed + number)
    write(args.output / "ripples.json", rows, args.seed)


if __name__ == "__main__":
    main()
