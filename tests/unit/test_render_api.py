"""What a user may do with `hx.render`: JAX transformations in every argument, precisions, compilations, errors."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import helio_jax as hx
from helio_jax.errors import SceneError
from helio_jax.instrument import Beam, Detector, Instrument, Plate
from tests.compilations import counted

SHAPE = (6, 7)
SIDES = ((2300.0, 100.0), (-1200.0, -1900.0), (-1100.0, 2000.0))
INSTRUMENT = Instrument(
    beam=Beam(incidence_deg=25.0, azimuth_deg=35.0),
    plate=Plate(working_distance_um=4000.0, sample_distance_um=4400.0),
    detector=tuple(Detector(name=f"{i}", center_um=c, axes_um=(1300.0, 900.0)) for i, c in enumerate(SIDES)),
)
OPTICS, RASTER = hx.Optics.of(INSTRUMENT), hx.Raster.regular(SHAPE, 12.0, 9.0)
MOVES = dict.fromkeys(("rotation", "incidence", "beam_azimuth"), 0.01)
MOVES |= {"distance": 5.0, "scale": 1.01, "plate_shift": (3.0, -2.0), "tilt": (0.01, 0.02)}
MOVES |= dict.fromkeys(("polar", "azimuth"), (0.01, 0.02, -0.01)) | {"size": (1.0, 1.1, 0.9)}


def arguments() -> dict[str, Any]:
    """Make a value of every argument that is a number."""
    rng = np.random.default_rng(2)
    height = 8.0 * rng.normal(size=SHAPE) + 40.0
    height[:, 4:] += 50.0
    readout = hx.Readout(
        gain=np.array([90.0, 100.0, 110.0]),
        offset=np.ones(3),
        drift=rng.normal(size=(3, 2)),
        drift_modes=rng.normal(size=(1, 2, *SHAPE)),
        pedestal=rng.normal(size=(3, 2)),
        pedestal_modes=rng.normal(size=(1, 2, *SHAPE)),
        lines=rng.normal(size=(3, SHAPE[0])),
    )
    return {
        "height": height,
        "optics": OPTICS,
        "raster": RASTER,
        "moves": MOVES,
        "readout": readout,
        "albedo": rng.uniform(0.8, 1.2, SHAPE),
        "law": hx.LobeLaw(0.3, 30.0),
    }


def image(tree: dict[str, Any], corrections: Any = "masking") -> jax.Array:
    """Render a tree of arguments."""
    names = ("readout", "albedo", "law")
    optics = tree["optics"].moved(**tree["moves"])
    options = {name: tree[name] for name in names}
    return hx.render(tree["height"], optics, tree["raster"], corrections=corrections, n_slices=4, **options)


def in_precision(tree: Any, dtype: Any) -> Any:
    return jax.tree.map(lambda a: jnp.asarray(a, dtype), tree)


@pytest.fixture(params=["float32", "float64"])
def precision(request):
    """A precision, with JAX set to compute in it."""
    with jax.enable_x64(request.param == "float64"):
        yield request.param


def corrections_of(kind: str) -> Any:
    """Make the corrections of a kind; a plan is made on the heights of `arguments`."""
    if kind != "plan":
        return kind
    height, moved = arguments()["height"], OPTICS.moved(**MOVES)
    surface = hx.surface_of_heights(jnp.asarray(height), RASTER)
    return hx.plan_radiosity(height, surface.normals(np.asarray(moved.beam_shift)), moved, RASTER)


@pytest.mark.parametrize("kind", ["none", "masking", "plan"])
def test_transformations(precision, kind):
    """jit, grad, jvp and vmap run in every number, keep its precision and agree with one another.

    The gradient of the image's sum of squares is multiplied by the direction of the jvp. Catches a conversion to NumPy,
    a Python branch on a value, a constant of another precision, a derivative that one of the modes lacks, and a
    callback that knows no batch.
    """
    plan, tree = corrections_of(kind), in_precision(arguments(), precision)
    direction = jax.tree.map(jnp.ones_like, tree)
    tolerance = 1e-4 if precision == "float32" else 1e-10
    if kind == "plan":
        tolerance = max(tolerance, 1e-6)  # where the series of the radiosity ends

    @jax.jit
    def run(tree):
        return image(tree, plan)

    def along(s):
        return run(jax.tree.map(lambda a, v: a + s * v, tree, direction))

    value, change = jax.jvp(run, (tree,), (direction,))
    gradient = jax.grad(lambda tree: jnp.sum(run(tree) ** 2))(tree)
    for leaf in jax.tree.leaves((value, change, gradient)):
        assert leaf.dtype == precision and np.all(np.isfinite(leaf))
    assert value.shape == (3, *SHAPE)
    parts = [float(np.sum(np.asarray(leaf, float))) for leaf in jax.tree.leaves(gradient)]
    expected = 2.0 * np.sum(np.asarray(value, float) * np.asarray(change, float))
    assert abs(sum(parts) - expected) <= tolerance * np.abs(parts).sum()
    batch = jax.vmap(along)(jnp.asarray([0.0, 1e-3, 2e-3], precision))
    assert batch.dtype == precision and np.abs(batch[0] - value).max() <= tolerance * np.abs(value).max()


@pytest.mark.parametrize("kind", ["none", "masking", "plan"])
def test_jacobians(kind):
    """jacfwd and jacrev run and agree, pixel by pixel, in the geometry and the law; float64.

    Catches a rule that knows no batch of tangents or cotangents, and one that mixes pixels or detectors.
    """
    plan = corrections_of(kind)
    with jax.enable_x64(True):
        tree = in_precision(arguments(), "float64")
        part = {name: tree[name] for name in ("law", "optics", "raster", "moves")}

        @jax.jit
        def run(part):
            return image(tree | part, plan)

        backward, forward = jax.jacrev(run)(part), jax.jacfwd(run)(part)
    for a, b in zip(jax.tree.leaves(backward), jax.tree.leaves(forward), strict=True):
        assert np.abs(a - b).max() <= (1e-6 if kind == "plan" else 1e-10) * np.abs(b).max()


def test_single_precision_is_close():
    """float32 agrees with float64 to 1e-5 of the brightest pixel; NumPy arguments are computed in float64.

    Catches a difference of large numbers, and a horizon that rounding moves to another sample.
    """
    exact = image(arguments())
    assert exact.dtype == np.float64
    rough = image(in_precision(arguments(), "float32"))
    assert rough.dtype == np.float32
    assert np.abs(np.asarray(exact) - np.asarray(rough)).max() < 1e-5 * np.abs(np.asarray(exact)).max()


def test_default_precision_of_a_derivative():
    """Without float64, a derivative by a Python number is float32, and right to 1e-3. Catches mixed precisions."""
    optics, height = OPTICS, arguments()["height"]
    found = jax.jacfwd(lambda d: hx.render(height, optics.moved(distance=d), RASTER))(0.0)
    assert found.dtype == np.float32
    images = [np.asarray(hx.render(height, optics.moved(distance=d), RASTER)) for d in (-0.01, 0.01)]
    exact = (images[1] - images[0]) / 0.02
    assert np.abs(found - exact).max() < 1e-3 * np.abs(exact).max()


@pytest.mark.parametrize("corrections", ["none", "masking"])
def test_batch_is_a_loop(corrections):
    """vmap over 16 geometries gives the images of a loop to 1e-12. Catches horizons of the wrong member of a batch."""
    height = arguments()["height"]
    with jax.enable_x64(True):
        several = jnp.stack([jnp.linspace(-300.0, 300.0, 16), jnp.linspace(-0.1, 0.1, 16)], -1)

        @jax.jit
        def one(move):
            optics = OPTICS.moved(distance=move[0], rotation=move[1])
            return hx.render(jnp.asarray(height), optics, RASTER, corrections=corrections)

        together, loop = jax.jit(jax.vmap(one))(several), jnp.stack([one(move) for move in several])
    assert np.abs(together - loop).max() < 1e-12 * np.abs(loop).max()
    assert np.abs(loop[0] - loop[-1]).max() > 0.01 * np.abs(loop).max()


@pytest.mark.parametrize("corrections", ["none", "masking"])
def test_one_compilation_serves_all_geometries(corrections):
    """After the first geometry, 20 others with other surfaces and read-outs compile nothing.

    Catches a number of the geometry that is a constant of the program. Its check: another raster shape compiles.
    """
    tree = arguments()

    def run(i: int, rows: int = SHAPE[0]) -> jax.Array:
        optics = OPTICS.moved(distance=10.0 * i, tilt=(1e-3 * i, 0.0), polar=1e-3 * i, incidence=1e-3 * i)
        readout = hx.Readout.ideal(3, 100.0 + i)
        height = (1.0 + 0.01 * i) * tree["height"][:rows]
        raster = hx.Raster(RASTER.x * (1.0 + 0.01 * i), RASTER.y[:rows])
        return hx.render(height, optics, raster, corrections=corrections, readout=readout, n_slices=5)

    run(0)
    with counted() as programs:
        for i in range(1, 21):
            run(i)
    assert not programs
    with counted() as programs:
        run(0, 5)
    assert programs


LAWS = {
    "power": lambda i: hx.PowerLaw(0.1 * i),
    "lobe": lambda i: hx.LobeLaw(0.05 * i, 20.0 + i),
    "rough": lambda i: hx.RoughLaw(0.04 * i),
    "monotone": lambda i: hx.MonotoneLaw(0.05 * i * np.linspace(-1.0, 1.0, 7)),
}


@pytest.mark.parametrize("kind", LAWS)
def test_one_compilation_serves_all_numbers_of_a_law(kind):
    """After the first, 10 other laws of a kind compile nothing, and the image follows the law.

    Catches a number of the law that is a constant of the program.
    """
    height = arguments()["height"]
    images = [np.asarray(hx.render(height, OPTICS, RASTER, corrections="none", law=LAWS[kind](0)))]
    with counted() as programs:
        images += [
            np.asarray(hx.render(height, OPTICS, RASTER, corrections="none", law=LAWS[kind](i))) for i in range(1, 11)
        ]
    assert not programs
    assert np.all(np.abs(np.diff(images, axis=0)).max((1, 2, 3)) > 1e-4 * images[0].max())


def test_radiosity_under_a_transformation():
    """ "radiosity" under a transformation of heights or optics is refused with the remedy; a plan is not.

    Outside of one it is the plan's image. Catches an error of JAX that tells a user nothing.
    """
    height = arguments()["height"]
    for transformed in (
        lambda: jax.grad(lambda h: hx.render(h, OPTICS, RASTER, corrections="radiosity").sum())(jnp.asarray(height)),
        lambda: jax.jacfwd(lambda d: hx.render(height, OPTICS.moved(distance=d), RASTER, corrections="radiosity"))(0.0),
        lambda: jax.jit(lambda h: hx.render(h, OPTICS, RASTER, corrections="radiosity"))(height),
    ):
        with pytest.raises(SceneError, match=r"plan = hx\.plan_radiosity"):
            transformed()
    surface = hx.Surface(height, 0.0 * height, 0.0 * height)
    plan = hx.plan_radiosity(height, surface.normals(OPTICS.beam_shift), OPTICS, RASTER)
    planned, direct = (hx.render(surface, OPTICS, RASTER, corrections=c) for c in (plan, "radiosity"))
    assert np.array_equal(planned, direct)
    assert np.asarray(direct - hx.render(surface, OPTICS, RASTER)).min() >= 0.0


def test_corrections_as_given():
    """Given `Corrections` are taken as they are; none of them is "none", those of the masks "masking"."""
    height = arguments()["height"]
    none = hx.Corrections.none((3, *SHAPE))
    plain = hx.render(height, OPTICS, RASTER, corrections="none")
    assert np.array_equal(hx.render(height, OPTICS, RASTER, corrections=none), plain)
    more = hx.Corrections(none.masked, none.multiple + 0.25)
    assert np.allclose(hx.render(height, OPTICS, RASTER, corrections=more) - plain, 0.25, rtol=1e-12)
