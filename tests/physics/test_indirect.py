"""Multiple scattering by radiosity: form factors in closed form, and the whole against the tracer."""

from pathlib import Path
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.radiosity import plan_radiosity, radiosity, transfer
from helio_jax.instrument import Detector, Instrument, Plate
from helio_jax.micrograph import MicrographStack
from helio_jax.trace.denoise import smooth_along_surface
from helio_jax.trace.intersect import Intersector
from helio_jax.trace.run import first_hits
from helio_jax.workflows.corrections import make_predictor
from helio_jax.workflows.scene_file import load_scene
from helio_jax.workflows.surface_hypotheses import LIMB

SCENES = Path(__file__).resolve().parents[2] / "scenes"
SIDE = Detector(name="side", polar_deg=40.0, half_angle_deg=10.0)


def row_sums(height: np.ndarray, normals: np.ndarray, pitch_um: float, n_azimuths: int = 32) -> np.ndarray:
    """Return the sum of each pixel's form factors [y, x] under a beam along z."""
    raster = Raster(*(pitch_um * (np.arange(n) - n // 2) for n in height.shape[::-1]))
    optics = Optics.of(Instrument(plate=Plate(working_distance_um=4000.0), detector=(SIDE,)))
    plan = plan_radiosity(height, normals, optics, raster, n_azimuths=n_azimuths)
    with jax.enable_x64(True):
        inputs = jax.tree.map(jnp.asarray, (height, normals, optics, (pitch_um, pitch_um), plan))
        weight, _ = transfer(*inputs)
    count = np.bincount(plan.strips.receiver.ravel(), np.asarray(weight).ravel(), height.size)
    return count[: height.size].reshape(height.shape)


def rms(image: np.ndarray) -> float:
    return float(np.sqrt(np.mean(image**2)))


def facing_up(height: np.ndarray) -> np.ndarray:
    return np.broadcast_to([0.0, 0.0, 1.0], (*height.shape, 3))


@pytest.mark.parametrize("depth", [40.0, 120.0])
def test_trench_floor(depth):
    """The middle of a long trench's floor sees the walls with 1 - 1 / sqrt(1 + (2 d / w)^2), to 1 %.

    Bias: the trench is 17 widths long, the rest is the azimuths. A wall stands in the cell beside the floor's last row,
    so that the width is that between the upper edges. Rejected: walls a row off on both sides (w -+ 17 %).
    """
    height = np.zeros((41, 201))
    height[15:26] = -depth
    width = 12 * 10.0
    seen = row_sums(height, facing_up(height), 10.0)
    assert seen[20, 100] == pytest.approx(1.0 - 1.0 / np.sqrt(1.0 + (2.0 * depth / width) ** 2), rel=0.01)
    assert np.abs(seen[:14]).max() < 1e-6  # a plane does not see itself


def test_wedge():
    """A floor before a wall of height b at distance a sees it with (1 - a / sqrt(a^2 + b^2)) / 2, to 2 %."""
    height = np.zeros((41, 201))
    height[30:] = 80.0
    seen = row_sums(height, facing_up(height), 10.0)
    a = 10.0 * (30 - np.arange(15, 29))
    assert np.allclose(seen[15:29, 100], 0.5 * (1.0 - a / np.hypot(a, 80.0)), rtol=0.02)


def test_white_furnace():
    """In a pit 30 times as deep as wide the rows of F sum to 1 - sin^2 of the opening's half-angle: 0.999 to 1."""
    height = np.zeros((15, 15))
    height[5:10, 5:10] = -1800.0
    seen = row_sums(height, facing_up(height), 10.0)
    assert np.all(seen <= 1.0 + 1e-9)
    assert np.all(seen[6:9, 6:9] > 0.998)


def predictions(name: str, **changes):
    """Return the stack of a scene's raster, its true heights and normals, and both predictions [detector, y, x]."""
    scene = load_scene(SCENES / f"{name}.toml", {key.replace("__", "."): value for key, value in changes.items()})
    x, y = scene.positions()
    grid_x, grid_y = np.meshgrid(x, y)
    hits = first_hits(Intersector(scene.build_body()), scene.instrument, grid_x.ravel(), grid_y.ravel())
    height, normals = hits.point[:, 2].reshape(grid_x.shape), hits.normal.reshape(*grid_x.shape, 3)
    stack = MicrographStack(np.zeros((3, *height.shape)), x, y, scene.instrument)
    about = "helio_jax.workflows.surface_hypotheses."
    with (  # as radiosity has them: the sheet along the beam, walls as ramps from pixel to pixel
        mock.patch(about + "LIMB", LIMB._replace(places=(0.0, 0.0))),
        mock.patch(about + "has_level_rims", lambda *_: False),
    ):
        traced, ours = (
            make_predictor(stack, 4_000_000, scene.substrate_size, multiple=model)(height, normals).multiple
            for model in ("traced", "radiosity")
        )
    return stack, height, normals, scene.substrate_size, traced, ours


def test_sphere_against_tracer():
    """Sphere A at 61 x 61: each mean is within 5 % of the tracer's, a pixel within 10 % of the mean (rms).

    Both smoothed alike. Measured: 0.5 to 1.8 %, and 7 % (rms), most at the sphere's foot.
    Rejected: exchanged detectors; by the mean also order 2 alone (-18 %).
    """
    stack, height, normals, _, traced, ours = predictions(
        "sphere_a", scan__nx=61, scan__ny=61, scan__pixel_size_um=60.0
    )
    assert np.all(np.abs(ours.mean((1, 2)) / traced.mean((1, 2)) - 1.0) < 0.05)
    x, y = np.meshgrid(stack.x, stack.y)
    shift = stack.instrument.beam_shift
    points = np.stack([x - shift[0] * height, y - shift[1] * height, height], -1)
    ours = smooth_along_surface(ours, normals, points, 60.0, degree=2)
    assert rms(ours - traced) < 0.1 * traced.mean()
    assert rms(ours[[1, 0, 2]] - traced) > 0.2 * traced.mean()


def test_trench_against_tracer():
    """A trench twice as wide as deep, 20 um pitch: the mean of all within 2 %, of each detector within 4 %.

    Rejected: walls that hide no detector from the points (12 % too much).
    """
    stack, height, normals, size, traced, ours = predictions(
        "trench", sample__width_um=240.0, sample__depth_um=120.0, scan__nx=61, scan__ny=31,
        scan__pixel_size_um=20.0, scan__center_um=[3.0, 4.0],
    )  # fmt: skip
    assert np.all(np.abs(ours.mean((1, 2)) / traced.mean((1, 2)) - 1.0) < 0.04)
    assert abs(ours.mean() / traced.mean() - 1.0) < 0.02
    optics, raster = Optics.of(stack.instrument), Raster.of(stack)
    plan = plan_radiosity(height, normals, optics, raster, substrate_um=size)
    with jax.enable_x64(True):
        plan = plan._replace(visible=np.ones_like(plan.visible))
        blind = np.asarray(radiosity(height, normals, optics, raster, plan))
    assert blind.mean() > 1.06 * traced.mean()
