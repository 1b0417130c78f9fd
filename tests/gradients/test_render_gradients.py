"""Derivatives of the render model in every number that it takes: Taylor remainders and the adjoint, in float64.

The surface is rough and has a step of 6 pitches, so that own horizons, masks by near pixels and a wall take part. No
two samples of the seed tie, and no slice crosses the edge of a mask within the longest step: there the exact mask has a
kink, and the remainder of a right derivative falls with slope 1.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import helio_jax as hx
from helio_jax.forward import radiosity
from helio_jax.instrument import Beam, Detector, Instrument, Plate
from tests.derivatives import adjoint_products, dot, taylor_remainders

SHAPE = (7, 9)
STEPS = 10.0 ** np.arange(-1.5, -3.6, -0.5)
N_SLICES = 6
RASTER = hx.Raster.regular(SHAPE, 12.0, 9.0)
OPTICS = [f"optics.{name}" for name in ("center", "axes", "beam_shift", "working_distance", "sample_distance")]
POSITIONS = ["raster.x", "raster.y"]
SURFACE = [f"surface.{name}" for name in ("height", "slope_x", "slope_y")]
READOUT = [
    f"readout.{name}" for name in ("gain", "offset", "drift", "drift_modes", "pedestal", "pedestal_modes", "lines")
]
MOVES: dict[str, Any] = {
    "plate_shift": (5.0, -3.0),
    "distance": 10.0,
    "scale": 1.01,
    "rotation": 0.02,
    "tilt": (0.03, -0.02),
    "incidence": 0.01,
    "beam_azimuth": -0.03,
    "polar": (0.01, -0.02),
    "azimuth": (0.02, 0.03),
    "size": (1.02, 0.97),
}
NO_MOVE = {"scale": 1.0, "size": (1.0, 1.0)}
LEAVES = {
    "masking": [*SURFACE, *OPTICS, *POSITIONS, "albedo", "law", *READOUT],
    "lobe": [*SURFACE, "optics", "law"],
    "rough law": ["law"],
    "monotone": [*SURFACE, "optics", "law"],
    "heights": ["surface", *POSITIONS],
    "edges": ["surface", "edges"],
    "plan": [*SURFACE, *OPTICS, *POSITIONS],
    "moved": [f"moves.{name}" for name in MOVES] + OPTICS,
    "moved from normal incidence": [f"moves.{name}" for name in MOVES if name != "beam_azimuth"] + OPTICS,
}
IS_AFFINE = {"albedo", *READOUT}
SIZE = {"surface": 0.3, "slope_x": 0.05, "slope_y": 0.05, "beam_shift": 0.003, "edges": 0.1}
SIZE |= {"exponent": 0.1, "share": 0.1, "width_deg": 3.0, "roughness": 0.1, "log_exponents": 0.1}
SIZE |= dict.fromkeys(MOVES, 1e-3) | {"plate_shift": 1.0}
SIZE |= dict.fromkeys(["distance", "working_distance", "sample_distance"], 10.0)
"""Standard deviation of a leaf's direction, 1 where it is not named: large against rounding, and so small that the
longest step crosses no kink, nor that the weights of slopes from heights alone change much."""


class Case(NamedTuple):
    """A function of a tree of arguments, and where it is derived."""

    function: Callable[[Any], Any]
    start: Any


def instrument(incidence_deg: float) -> Instrument:
    """Make an oblique beam along an odd azimuth and two rotated ellipses."""
    ellipses = (((2300.0, 100.0), 20.0), ((-1100.0, 2000.0), -40.0))
    return Instrument(
        beam=Beam(incidence_deg=incidence_deg, azimuth_deg=35.0 if incidence_deg else 0.0),
        plate=Plate(working_distance_um=4000.0, sample_distance_um=4400.0),
        detector=tuple(
            Detector(name=f"{i}", center_um=center, axes_um=(1300.0, 900.0), rotation_deg=rotation)
            for i, (center, rotation) in enumerate(ellipses)
        ),
    )


def rough_surface(rng: np.random.Generator) -> hx.Surface:
    """Make random heights [um] with a step, and random slopes."""
    height, (slope_x, slope_y) = 8.0 * rng.normal(size=SHAPE) + 40.0, 0.5 * rng.normal(size=(2, *SHAPE))
    height[:, 5:] += 70.0
    return hx.Surface(height, slope_x, slope_y)


def readout(rng: np.random.Generator) -> hx.Readout:
    """Make random values of all that a read-out holds."""
    shapes = ((2,), (2,), (2, 3), (1, 3, *SHAPE), (2, 2), (2, 2, *SHAPE), (2, SHAPE[0]))
    gain, *rest = (rng.normal(size=shape) for shape in shapes)
    return hx.Readout(100.0 + 10.0 * gain, *rest)


def render_of(tree: dict[str, Any], corrections: Any = "masking") -> jax.Array:
    """Render a tree of arguments."""
    optics = tree["optics"].moved(**tree.get("moves", {}))
    names = {"readout", "albedo", "law", "edges"} & tree.keys()
    options = {name: tree[name] for name in names} | {"corrections": corrections, "n_slices": N_SLICES}
    return hx.render(tree["surface"], optics, tree.get("raster", RASTER), **options)


def make_case(name: str) -> Case:
    """Make the arguments of a case and its compiled function."""
    rng = np.random.default_rng(9)
    surface, tilted = rough_surface(rng), hx.Optics.of(instrument(25.0)).moved(tilt=(0.03, -0.02))
    more = {"raster": RASTER, "albedo": rng.uniform(0.8, 1.2, SHAPE), "law": hx.PowerLaw(0.4), "readout": readout(rng)}
    weights = tuple(rng.uniform(0.3, 1.0, (SHAPE[0] - i, SHAPE[1] - 1 + i)) for i in (0, 1))
    moved = {"surface": surface, "optics": hx.Optics.of(instrument(25.0)), "moves": MOVES}
    scattered = {"surface": surface, "optics": tilted}
    steep = hx.Optics.of(instrument(0.0))
    still = {k: NO_MOVE.get(k, np.zeros(np.shape(v))) for k, v in MOVES.items()}
    start: dict[str, Any] = {
        "masking": {"surface": surface, "optics": tilted, **more},
        "lobe": scattered | {"law": hx.LobeLaw(0.4, 25.0)},
        "rough law": scattered | {"law": hx.RoughLaw(0.3)},
        "monotone": scattered | {"law": hx.MonotoneLaw(0.5 * rng.normal(size=7))},
        "heights": {"surface": surface.height, "optics": tilted, "raster": RASTER},
        "edges": {"surface": surface.height, "optics": tilted, "edges": weights},
        "plan": {"surface": surface, "optics": tilted, "raster": RASTER},
        "moved": moved,
        "moved from normal incidence": moved | {"optics": steep, "moves": still},
    }[name]
    plan: Any = "masking"
    if name == "plan":
        plan = hx.plan_radiosity(surface.height, surface.normals(np.asarray(tilted.beam_shift)), tilted, RASTER)
    return Case(jax.jit(lambda tree: render_of(tree, plan)), jax.tree.map(jnp.asarray, start))


@pytest.fixture(scope="module")
def cases():
    """The cases by name, made when first wanted, so that all leaves of one share what is compiled."""
    made: dict[str, Case] = {}

    def of(name: str) -> Case:
        return made.setdefault(name, made.get(name) or make_case(name))

    with jax.enable_x64(True), pytest.MonkeyPatch.context() as patch:
        # the series of the radiosity ends when its terms are small, which is not smooth
        patch.setattr(radiosity, "TOLERANCE", 1e-14)
        yield of


def direction(start: Any, leaf: str, rng: np.random.Generator) -> Any:
    """Make a random direction in one argument, or in all, "all"."""

    def of(path: Any, value: Any) -> Any:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        size = next((SIZE[part] for part in name.split(".") if part in SIZE), 1.0)
        is_chosen = leaf == "all" or f"{name}.".startswith(f"{leaf}.")
        return jnp.asarray(size * is_chosen * rng.normal(size=value.shape))

    return jax.tree_util.tree_map_with_path(of, start)


ALL_LEAVES = [(name, leaf) for name, leaves in LEAVES.items() for leaf in leaves]


@pytest.mark.parametrize(("name", "leaf"), ALL_LEAVES)
def test_taylor(cases, name, leaf):
    """The Taylor remainder in each argument falls with slope 2.00 +- 0.05 over 2 decades of step.

    0 but for rounding where the image is linear in the argument. Rejected wrong models: a derivative that leaves out
    one way in which the argument acts (the form factor, the slices, the horizon, the slopes by the pitch, the sender of
    a strip): slope 1; so also a `stop_gradient` or a conversion to NumPy on the way.
    """
    function, start = cases(name)
    v = direction(start, leaf, np.random.default_rng(11))
    rest = np.array(taylor_remainders(function, start, v, STEPS))
    change = jax.jvp(function, (start,), (v,))[1]
    size = np.sqrt(dot(change, change))
    assert size > 0.0
    if leaf in IS_AFFINE:
        assert np.all(rest < 1e-9 * STEPS * size)
        return
    orders = np.diff(np.log10(rest)) / np.diff(np.log10(STEPS))
    assert np.all(np.abs(orders - 2.0) < 0.05), orders


@pytest.mark.parametrize("name", LEAVES)
def test_adjoint(cases, name):
    """<J v, w> = <v, J' w> to 1e-10, in each argument and in all together.

    Catches a backward rule that is not the transpose of the forward one: of the contour integral, the checkpointed
    slices, the padding, and the solve of the radiosity.
    """
    function, start = cases(name)
    rng = np.random.default_rng(13)
    for leaf in [*LEAVES[name], "all"]:
        v = direction(start, leaf, rng)
        forth, back = adjoint_products(function, start, v, lambda f: jnp.asarray(rng.normal(size=f.shape)))
        assert forth == pytest.approx(back, rel=1e-10), leaf


@pytest.mark.parametrize("wanted", ["surface", "optics"])
def test_derivative_of_one_argument_alone(cases, wanted):
    """The derivative in heights or optics alone is that of all arguments in this direction, to 1e-12.

    The rule of the form factor leaves out arguments without a tangent. Catches a rule that then leaves out too much.
    """
    function, start = cases("masking")
    v = direction(start, wanted, np.random.default_rng(17))
    whole = jax.jvp(function, (start,), (v,))[1]
    alone = jax.jvp(lambda part: function(start | {wanted: part}), (start[wanted],), (v[wanted],))[1]
    assert np.allclose(alone, whole, rtol=1e-12, atol=1e-12 * np.abs(whole).max())


def test_surface_is_informative(cases):
    """At least a tenth of all apertures is masked in part, and some pixels see a change by a distant height.

    Catches a surface on which the masks' derivatives would not be tested.
    """
    tree = cases("masking").start
    optics, bare = tree["optics"], {"surface": tree["surface"], "optics": tree["optics"]}
    masked, whole = (np.asarray(render_of(bare, kind)) for kind in ("masking", "none"))
    share = 1.0 - masked / whole
    assert optics.n_detectors == 2
    assert np.mean((share > 1e-3) & (share < 0.999)) > 0.1
