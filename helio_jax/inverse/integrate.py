"""Slopes to height: the one door to the integrators.

Works in the beam frame: a = dh/dX, b = dh/dY per um of raster, height upwards, x with the column and y with the row
(`helio_jax.arrays`). Slopes say nothing of the piston: heights come with mean zero, and levelling on the substrate is
the caller's matter. NumPy and SciPy only, no derivatives; the fit of heights to micrographs is `refine`.
"""

import inspect
from typing import Any

import numpy as np

from helio_jax.arrays import as_float_array, nearest_known
from helio_jax.errors import GuardError, SceneError
from helio_jax.inverse.integrate_bilateral import integrate_bilateral
from helio_jax.inverse.integrate_jumps import integrate_cutting_jumps, integrate_weighted
from helio_jax.inverse.integrate_poisson import EdgesX, EdgesY, Image, integrate_poisson
from helio_jax.inverse.integrate_sylvester import integrate_sylvester

METHODS = ("weighted", "dct_poisson", "harker_oleary", "bilateral")


def integrate_slopes(
    a: Image,
    b: Image,
    dx: float,
    dy: float,
    method: str = "weighted",
    weights: Image | None = None,
    **options: Any,
) -> Image:
    """Integrate slopes to a height map.

    Pixels of weight 0 have an unknown slope: it is replaced by that of the nearest known pixel and, in `weighted` and
    `bilateral`, trusted 1e-6 of the median.

    Args:
        a, b: slopes dh/dX and dh/dY at the pixel centres [1]; NaN only where the weight is 0. At least 3 x 3 pixels.
        dx, dy: pitches [um], > 0.
        method:
            `weighted`: weighted Poisson that cuts jump edges (`integrate_cutting_jumps`, whose options it takes);
                with `cut_jumps=False` plain weighted least squares (`integrate_weighted`).
            `dct_poisson`: Poisson with equal weights, exact and fast.
            `harker_oleary`: Sylvester equation; option `variant` (`integrate_sylvester`).
            `bilateral`: BiNI (`integrate_bilateral`).
        weights: pixel confidences >= 0, proportional to the inverse variance; all 1 by default. `dct_poisson` and
            `harker_oleary` take only two values, 0 and another.
        options: of the method; unknown ones are refused.

    Returns:
        height [um] of mean zero (`harker_oleary` with `variant="dirichlet"`: zero on the border).

    Raises:
        SceneError: wrong shapes, pitches, weights, method or options.
        GuardError: a slope is not finite where its weight is > 0; no known slope; a solver did not converge.
    """
    if method not in METHODS:
        raise SceneError(f"method must be one of {', '.join(METHODS)}, got {method!r}")
    a, b, trust = _prepare(a, b, dx, dy, weights)
    if method == "weighted":
        if options.pop("cut_jumps", True):
            return _call(integrate_cutting_jumps, options, a, b, dx, dy, trust)[0]
        return _call(integrate_weighted, options, a, b, dx, dy, trust)
    if method == "bilateral":
        return _call(integrate_bilateral, options, a, b, dx, dy, trust)
    if np.ptp(trust[trust > 0]) > 0:
        raise SceneError(f"weights must be 0 or all equal for {method}, got graded ones: use method='weighted'")
    return _call(integrate_poisson if method == "dct_poisson" else integrate_sylvester, options, a, b, dx, dy)


def integrate_with_jumps(
    a: Image, b: Image, dx: float, dy: float, weights: Image | None = None, **options: Any
) -> tuple[Image, EdgesX, EdgesY]:
    """Integrate as `integrate_slopes(..., method="weighted")` and return the cut edges too.

    Returns:
        height [um]; jump_x of the edges (i, j)-(i, j+1) and jump_y of the edges (i, j)-(i+1, j), from 1 = intact to
        0 = cut; below 1/4 the misfit exceeds `cut` standard deviations of that edge. An edge beside a grazing pixel has
        a large one: it counts for little in the fit and yet may be marked intact.
    """
    a, b, trust = _prepare(a, b, dx, dy, weights)
    return _call(integrate_cutting_jumps, options, a, b, dx, dy, trust)


def _call(function: Any, options: dict[str, Any], *arguments: Any) -> Any:
    """Call `function` with `options` after refusing those that it does not know."""
    known = [p.name for p in inspect.signature(function).parameters.values() if p.kind is p.KEYWORD_ONLY]
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise SceneError(f"options must be among {', '.join(known) or 'none'}, got {', '.join(unknown)}")
    return function(*arguments, **options)


def _prepare(a: Image, b: Image, dx: float, dy: float, weights: Image | None) -> tuple[Image, Image, Image]:
    """Check slopes; fill unknown ones from the nearest known pixel; make the weights."""
    a = as_float_array("a", a, (None, None), SceneError)
    b = as_float_array("b", b, a.shape, SceneError)
    trust = np.ones(a.shape) if weights is None else as_float_array("weights", weights, a.shape, SceneError)
    if min(a.shape) < 3:
        raise SceneError(
            f"heights need an image of at least 3 x 3 pixels, got {a.shape[0]} rows x {a.shape[1]} columns: scan an "
            "area, a line does not tell the slopes across it"
        )
    for name, value in (("dx", dx), ("dy", dy)):
        if not (np.isfinite(value) and value > 0):
            raise SceneError(f"{name} must be finite and > 0 um, got {value:g}")
    if not (np.all(np.isfinite(trust)) and trust.min() >= 0):
        raise SceneError(f"weights must be finite and >= 0, got a smallest of {trust.min():g}")
    is_known = trust > 0
    n_bad = int(np.sum(is_known & ~(np.isfinite(a) & np.isfinite(b))))
    if n_bad:
        raise GuardError(f"slopes must be finite where their weight is > 0, {n_bad} pixels are not: set weight 0 there")
    if not is_known.any():
        raise GuardError("at least one pixel must have a weight > 0, got none")
    if not is_known.all():
        nearest = nearest_known(is_known, (dy, dx))
        a, b = a[nearest], b[nearest]
    return a, b, trust
