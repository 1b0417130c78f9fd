"""Areal surface texture of a height map (ISO 25178): scale-limited surface, parameters, their errors and noise bias.

Height map -> regular grid of the sample frame -> S-filter -> F-operator -> L-filter -> parameters. The same is done
for heights plus and minus each posterior sample of their errors. The spread of the parameters is their standard
deviation; their mean shows how much such errors add to them, if they are noise.
"""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from pydantic import Field

from helio_jax.arguments import checked
from helio_jax.errors import GuardError, SceneError
from helio_jax.heightmap import HeightMap
from helio_jax.measure.areal_filters import Form, form_surface, gaussian_mean
from helio_jax.measure.sample_surface import SampleSurface, sample_surface
from helio_jax.measure.texture_parameters import PARAMETERS, texture_parameters
from helio_jax.reconstruction import Reconstruction
from helio_jax.settings import Settings

MIN_PIXELS = 100
"""Fewest known heights of a scale-limited surface."""
MIN_NESTING = 3.0
"""Smallest nesting index of the S-filter [pitches], after ISO 25178-3."""
_DRAWS, _SEED = 32, 25178
"""Draws of errors where there are no posterior samples, and their seed."""


class TextureSettings(Settings):
    """The scale-limited surface of which the texture is measured."""

    form: Form = "plane"
    """F-operator: what is subtracted by least squares: "none" (the mean), "plane", "quadratic"."""
    s_filter_um: float | None = Field(default=None, gt=0.0)
    """Nesting index of the S-filter, which removes shorter waves [um]; default: none."""
    l_filter_um: float | None = Field(default=None, gt=0.0)
    """Nesting index of the L-filter, which removes longer waves [um]; default: none."""
    grid_um: float | None = Field(default=None, gt=0.0)
    """Pitch of the grid in the sample frame [um]; default: the raster, or its smaller pitch at oblique incidence."""
    subtract_noise: bool = False
    """Whether the noise bias is subtracted: only where the stated errors are noise that was added to the heights. A
    regularised fit smooths instead, and its errors hold more than noise."""


@dataclass(frozen=True)
class Parameter:
    """One parameter.

    Attributes:
        value: of the heights as they are, less `noise_bias` if that was requested; NaN: not defined.
        std: its standard deviation; NaN: unknown.
        noise_bias: what the errors have added to it, if they are noise in the heights; NaN: unknown.
        unit: "um", "%" or "".
    """

    value: float
    std: float
    noise_bias: float
    unit: str


@dataclass(frozen=True)
class Texture:
    """Areal surface texture parameters of a scale-limited surface; `texture.Sq` is the value of one.

    Attributes:
        parameters: name -> `Parameter`.
        settings: filters, form, grid.
        surface: "S-F surface" (without L-filter) or "S-L surface".
        n_pixels: known heights.
        share: known heights over all of the grid's.
        pitch_um: of the grid along x and y [um].
        grid: how the heights came onto it.
        errors: where the standard deviations come from.
    """

    parameters: dict[str, Parameter]
    settings: TextureSettings
    surface: str
    n_pixels: int
    share: float
    pitch_um: tuple[float, float]
    grid: str
    errors: str

    def __getattr__(self, name: str) -> float:
        if name in PARAMETERS:
            return self.parameters[name].value
        raise AttributeError(
            f"{type(self).__name__} has no attribute {name!r}; its parameters are {', '.join(PARAMETERS)}"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return all as nested dictionaries."""
        return {
            **{k: v for k, v in vars(self).items() if k not in ("parameters", "settings")},
            "settings": self.settings.model_dump(),
            "parameters": {name: asdict(p) for name, p in self.parameters.items()},
        }


def scale_limited(z: np.ndarray, steps: tuple[float, float], settings: TextureSettings) -> np.ndarray:
    """Apply S-filter, F-operator and L-filter to heights, in this order, and subtract the mean [y, x], um.

    Args:
        z: heights [y, x], um; NaN: unknown.
        steps: pitch along y and x [um].
        settings: filters and form.

    Source: ISO 25178-3:2012: S-F surface, S-L surface.
    """
    if settings.s_filter_um:
        z = gaussian_mean(z, settings.s_filter_um, steps)
    z = z - form_surface(z, settings.form, steps)
    if settings.l_filter_um:
        z = z - gaussian_mean(z, settings.l_filter_um, steps)
    return z - np.nanmean(z)


@checked
def measure_texture(
    heights: Reconstruction | HeightMap,
    settings: TextureSettings | None = None,
    *,
    region: np.ndarray | None = None,
    **changes: Any,
) -> Texture:
    """Measure the areal surface texture parameters of ISO 25178-2 in the sample frame, with standard deviations.

    Heights that are not valid are left out. Standard deviations come from the posterior samples of the heights, which
    hold the correlation of their errors; without samples from `height_std`, with errors taken as independent from
    pixel to pixel, which is too small for parameters of long waves.

    Example:
        >>> texture = hx.measure_texture(rec, l_filter_um=250.0)  # doctest: +SKIP
        >>> texture.Sq, texture.parameters["Sq"].std  # doctest: +SKIP

    Args:
        heights: a reconstruction, or a height map on a regular grid.
        settings: the scale-limited surface; default: no filter, levelled by a plane.
        region: True for the pixels of the raster that count [y, x]; default: all.
        changes: settings that replace those: form, s_filter_um, l_filter_um, grid_um.

    Raises:
        SceneError: an unknown setting; a nesting index that is too small for the pitch or too large for the field.
        GuardError: fewer than `MIN_PIXELS` heights are known.

    Source: ISO 25178-2:2021, ISO 25178-3:2012; docs/metrology.md.
    """
    how = (settings or TextureSettings()).changed(**changes)
    surface = sample_surface(heights, region=region, grid_um=how.grid_um)
    n_known = int(np.isfinite(surface.height).sum())
    if n_known < MIN_PIXELS:
        raise GuardError(
            f"surface texture needs {MIN_PIXELS} or more valid heights, got {n_known} of {surface.height.size}: choose "
            "a larger region"
        )
    _check_nesting(surface, how)
    measure = lambda z: texture_parameters(scale_limited(z, surface.steps, how), surface.steps)  # noqa: E731
    measured = measure(surface.height)
    errors = _Errors.of(surface, heights)
    drawn = [[measure(surface.height + sign * d) for sign in (1.0, -1.0)] for d in errors.deviations()]
    known = np.isfinite(surface.height)
    rows, columns = np.nonzero(known)
    return Texture(
        parameters={name: _parameter(name, measured[name], drawn, how.subtract_noise) for name in PARAMETERS},
        settings=how,
        surface="S-L surface" if how.l_filter_um else "S-F surface",
        n_pixels=n_known,
        share=float(known[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1].mean()),
        pitch_um=(surface.steps[1], surface.steps[0]),
        grid=surface.how,
        errors=errors.source,
    )


def _check_nesting(surface: SampleSurface, how: TextureSettings) -> None:
    """Check the nesting indices against the pitch and the field.

    Raises:
        SceneError: they do not fit.
    """
    pitch_, side = max(surface.steps), min(np.ptp(surface.x), np.ptp(surface.y))
    s, l = how.s_filter_um, how.l_filter_um  # noqa: E741
    if s is not None and s < MIN_NESTING * pitch_:
        raise SceneError(
            f"s_filter_um must be at least {MIN_NESTING:g} pitches of {pitch_:g} um, got {s:g}: choose "
            f"{MIN_NESTING * pitch_:g} or more, or none"
        )
    if l is not None and l > side:
        raise SceneError(f"l_filter_um must be at most the shorter side of the field, {side:g} um, got {l:g}")
    if s is not None and l is not None and s >= l:
        raise SceneError(f"s_filter_um must be less than l_filter_um, got {s:g} and {l:g}: no waves would be left")


@dataclass(frozen=True)
class _Errors:
    """Deviations of the heights to draw, and what they are in words."""

    surface: SampleSurface
    samples: np.ndarray | None
    std: np.ndarray | None
    source: str

    @classmethod
    def of(cls, surface: SampleSurface, heights: Reconstruction | HeightMap) -> "_Errors":
        if surface.height_samples is not None and len(surface.height_samples) > 1:
            n = len(surface.height_samples)
            return cls(
                surface, surface.height_samples, None, f"{n} posterior samples of the heights, correlated errors"
            )
        if surface.height_std is not None and np.isfinite(surface.height_std).any():
            words = "standard deviation of each height, errors taken as independent: too small for long waves"
            return cls(surface, None, surface.height_std, words)
        return cls(surface, None, None, "unknown: the height map states no errors")

    def deviations(self) -> Iterator[np.ndarray]:
        """Yield deviations of all heights [y, x], um."""
        if self.samples is not None:
            yield from self.samples
        elif self.std is not None:
            rng = np.random.default_rng(_SEED)
            for _ in range(_DRAWS):
                yield self.std * rng.standard_normal(self.std.shape)


def _parameter(name: str, value: float, drawn: list[list[dict[str, float]]], subtract: bool) -> Parameter:
    """Compute a parameter's standard deviation and its noise bias from pairs of draws of opposite errors.

    Each draw adds errors once more. If they are noise, what a draw adds on average is what the noise in the heights has
    added before, to first order in its variance: simulation extrapolation.

    Source: Cook and Stefanski, J. Am. Stat. Assoc. 89 (1994) 1314 (SIMEX, linear extrapolant).
    """
    if not drawn:
        return Parameter(value, math.nan, math.nan, PARAMETERS[name].unit)
    pairs = np.array([[d[name] for d in pair] for pair in drawn])
    # opposite errors change a parameter oppositely to first order: half their difference is the draw without its bias
    std = float(np.sqrt(np.mean((0.5 * (pairs[:, 0] - pairs[:, 1])) ** 2)))
    if PARAMETERS[name].grows_as_root:
        clean = math.sqrt(max(2.0 * value**2 - float(np.mean(pairs**2)), 0.0))
    else:
        clean = 2.0 * value - float(np.mean(pairs))
    return Parameter(clean if subtract else value, std, value - clean, PARAMETERS[name].unit)
