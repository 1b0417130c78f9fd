"""Known shapes in closed form: against the tracer, which shares no code with them, and their derivatives."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import helio_jax as hx
from helio_jax.calibration.known_model import ScanModel, no_multiple
from helio_jax.calibration.known_objects import KnownObject
from helio_jax.calibration.unknowns import OBJECT, PLATE
from helio_jax.forward.known_shapes import Ball
from helio_jax.workflows.known_scene import known_scene
from tests.derivatives import taylor_remainders

AXIS = 110.0 * (np.arange(27) - 13.0)
TILT = {"tilt x": math.radians(2.0), "tilt y": math.radians(-1.5)}
CASES = {
    "ball 690": ("ball radius=1000", {"radius": 1000.0, "height": 690.0, "object x": 36.0, "object y": -51.0}),
    "step 400": (
        "step height=400",
        {"height": 400.0, "object x": 100.0, "slope": 0.5 * math.pi, "object azimuth": 2.8},
    ),
    "wedge 400": (
        "wedge height=400 slope=50",
        {"height": 400.0, "object x": 100.0, "slope": math.radians(50.0), "object azimuth": 1.7},
    ),
}
PLATE_MOVES = (310.0, -150.0, 0.03, 0.02, -120.0, 0.01)


def unknowns(numbers: dict[str, float], moves=PLATE_MOVES) -> np.ndarray:
    """Return the unknowns of a plate with 3 apertures and an object."""
    assert len(moves) == len(PLATE)
    return np.array([*moves, *[0.0] * 6, *(numbers.get(name, 0.0) for name in OBJECT)])


def model_of(bshem, text: str) -> ScanModel:
    return ScanModel(hx.Optics.of(bshem), hx.Raster(AXIS, AXIS), KnownObject.parse(text).kind)


def lies_off_outline(model: ScanModel, at: np.ndarray, margin: float) -> np.ndarray:
    """Find the pixels of which one part has nearly all, at a distance of more than `margin` [um] from the outline."""
    with jax.enable_x64(True):
        at = jnp.asarray(at)
        parts = model.shape_of(at).parts(model.raster, model.moved_optics(at).beam_shift, margin / 5.0)
        shares = np.stack([np.asarray(share) for share, _, _ in parts])
    assert np.sum(shares, 0) == pytest.approx(1.0, abs=1e-9)
    return np.max(shares, 0) > 0.99


@pytest.mark.parametrize("tilt", [{}, TILT], ids=["level", "tilted"])
@pytest.mark.parametrize("case", CASES)
def test_single_scattering_is_the_tracers(bshem, case, tilt):
    """Single scattering of a moved instrument equals the traced one, masks and albedo included.

    Catches a wrong sign of tilt, azimuth or plate shift, another order of the plate's motions in `Instrument.moved` and
    `Optics.moved`, a horizon of the wrong tangent, and an albedo on the wrong side. Where an aperture is cut, the
    tracer's shadow rays are noisy (rays = 256) and the slices of an aperture few: 6 % at worst there, 1e-4 elsewhere.
    """
    text, numbers = CASES[case]
    albedo = {"log albedo ratio": math.log(0.9)} if text.startswith("ball") else {}
    at = unknowns(numbers | tilt | albedo)
    model, moves = model_of(bshem, text), PLATE_MOVES
    true = bshem.moved(
        np.zeros((3, 2)), moves[4], plate_shift=moves[:2], scale=1.0 + moves[2], rotation=moves[3], incidence=moves[5]
    )
    o = dict(zip(OBJECT, at[-len(OBJECT) :], strict=True))
    scene = known_scene(KnownObject.parse(text), o, true, AXIS, AXIS, substrate_um=8000.0)
    pencil = scene.beam.model_copy(update={"pinhole_radius_um": 0.0})
    stack = hx.simulate(scene.model_copy(update={"beam": pencil}), rays=256, maps=False).only()
    traced = (stack.by_order[0] / stack.n_rays).reshape(3, AXIS.size, AXIS.size)
    with jax.enable_x64(True):
        found = np.asarray(model.probability(jnp.asarray(at), no_multiple(model, at, np.array([], int))))
    scale = np.median(traced, axis=(1, 2), keepdims=True)
    error = np.abs(found - traced) / scale
    clear = lies_off_outline(model, at, 1.0)
    assert clear.mean() > 0.97
    assert np.quantile(error[:, clear], 0.9) < 1e-4
    assert error[:, clear].max() < 0.06 and abs(np.mean((found - traced)[:, clear] / scale)) < 3e-4


@pytest.mark.parametrize("case", CASES)
def test_derivatives_of_all_unknowns(bshem, case):
    """The remainder falls as the square of the step in every unknown. Catches a cut derivative (slope 1).

    Pixels on the outline, blurred over 30 um, are included. Multiple scattering is left out: its expansion is linear by
    construction.
    """
    text, numbers = CASES[case]
    at = unknowns(numbers | TILT | {"log albedo ratio": 0.1, "exponent": 0.05})
    model = model_of(bshem, text)
    size = [1.0, 1.0, 1e-3, 1e-3, 1.0, 1e-3, *[1e-3] * 6, 1.0, 1.0, 1e-3, 1e-3, 1e-3, 1.0, 1.0, 1e-3, 1e-2, 1e-2, 0.0]
    with jax.enable_x64(True):
        nothing = jax.tree.map(jnp.asarray, no_multiple(model, at, np.array([], int)))
        member = jnp.exp(model.parts(jnp.asarray(at + 0.3 * np.array(size)), nothing, 30.0)[1])  # about, not at
        function = jax.jit(lambda u: jnp.concatenate([f.ravel() for f in model.fitted(u, nothing, 30.0, member)]))
        for number, step in enumerate(size):  # kinks, where a slice meets the edge of a mask, need small steps
            direction = jnp.zeros(len(at)).at[number].set(step)
            first, second = taylor_remainders(function, jnp.asarray(at), direction, (0.1, 0.01))
            assert second < 0.03 * first or first < 1e-12, (case, number)


@pytest.mark.parametrize("height", [300.0, 650.0, 1000.0, 1040.0])
@pytest.mark.parametrize("slope", [0.0, 0.3, 0.577, 1.0])
def test_covered_points_are_moved_to_the_outline(height, slope):
    """Points that the ball covers come to lie just outside of it, as a continuous function of their place.

    A jump trapped the fit: any step of the object cost as much as one pixel that is masked on one side only. Catches
    centres that do not lie between the foot and the contour of grazing beams. No chance is involved.
    """
    ball = Ball(jnp.asarray(1000.0), jnp.asarray(height))
    shift = slope * jnp.array([math.cos(0.3), math.sin(0.3)])
    angle, share = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False), np.linspace(0.5, 1.2, 30)[:, None]
    with jax.enable_x64(True):
        depth, steep = height - 1000.0, slope**2
        both = depth**2 < steep * (1000.0**2 - depth**2)
        center = (-depth / steep if both else max(depth, 0.0)) * np.asarray(shift)
        ways = 1000.0 * share * np.array([np.cos(angle), np.sin(angle)])[:, None]
        x, y = (jnp.asarray(center[i] + ways[i]) for i in (0, 1))

        def is_on(x, y):
            return np.asarray(ball.parts(x, y, shift, 0.0)[0].share) > 0.5

        moved = ball._beside(x, y, shift)
        on = is_on(x, y)
        assert on.any() and not on.all()
        assert not is_on(*moved).any()
        inside = [m - 1e-3 * (m - c) for m, c in zip(moved, center, strict=True)]
        assert is_on(*inside)[on].all()
        stay = ~on & ~is_on(*[c + (v - c) / (1.0 + 1e-5) for v, c in zip((x, y), center, strict=True)])
        assert all(np.array_equal(np.asarray(m)[stay], np.asarray(v)[stay]) for m, v in zip(moved, (x, y), strict=True))
        steps = np.hypot(*[np.diff(np.asarray(m), axis=1) for m in moved])
        assert steps[0].max() < 60.0  # 720 angles about an outline of up to 2.5 mm from its centre
