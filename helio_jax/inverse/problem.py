"""The inverse problem: what is constant during a fit, as one frozen record.

Unknowns are heights and two slopes of every pixel and the `Parameters`; known are the data, the instrument as stated,
priors, and whether the border lies on the substrate. Nothing is changed in place: `state` holds all that changes.
"""

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from helio_jax.arrays import border_mask, typical_signals
from helio_jax.forward.laws import Law
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.readout import ScanOrder, drift_modes
from helio_jax.forward.surface import Surface
from helio_jax.geometry_prior import GeometryPrior
from helio_jax.instrument import Instrument, Uncertainty
from helio_jax.inverse.albedo_patches import AlbedoPatches
from helio_jax.inverse.anchors import Anchors
from helio_jax.inverse.border_level import border_levels, border_signal
from helio_jax.inverse.law_prior import check_law, law_prior, numbers_of
from helio_jax.inverse.linear import MIN_IMAGES
from helio_jax.inverse.parameters import LawPrior, Parameters, Priors, law_of, moves_of, smooth_albedo
from helio_jax.inverse.quality import MIN_REGION, regions
from helio_jax.inverse.settings import ReconstructSettings, RefineSettings

LEVEL_STD = 0.1
"""Standard deviation of a held mean height [um]."""
_BARELY_HELD = 1e-5
"""Least prior weight of a height, 1/um: holds a pixel that all edges separate from the others."""


@dataclass(frozen=True)
class FitProblem:
    """What is constant during a fit.

    Attributes:
        signal, variance: data in units of the beam [detector, y, x], NaN where not observed.
        optics: as stated.
        tilt_std: prior standard deviation of the substrate's tilt, about each of x and y [rad].
        discrepancy_std: prior standard deviation of what the model lacks, over the median signal.
        geometry: prior of distance and directions.
        raster: beam positions.
        reconstruct_settings: of the fit (`settings`), and what is known of the border.
        order: in which the pixels were recorded.
        is_level_held, is_level_free: whether the mean height is held, or unknown; a flat border does neither.
        held_level: mean height that is held, over its standard deviation.
        anchors: what is known of the heights.
        region: number of the plateau of every pixel, whose masks are to follow their levels, 0: none [y, x].
        drift_modes: shapes of the slow drift [detector or 1, mode, y, x].
        median_signal: of every detector; the mean where more than half of its pixels have no counts, 1 without data
            [detector].
        slope_noise: typical standard deviation of the slopes of one pixel.
        patches: parts of the surface of other albedo, which is unknown.
        parallax: how the signal changes per um that the surface is higher than `parallax_height` [detector, y, x], 0
            for one beam.
        parallax_height: at which the images of several beams were read [y, x], um.
        noise_share: noise of every pixel over the typical one, by its dwell time [y, x]; None: all alike.
        walls: whether a wall parts neighbours along x and y [y, x - 1], [y - 1, x]; None: no wall is known.
        off_substrate: pixels known to be above or below the substrate, to which a flat border does not apply [y, x];
            None: none is known.
        instrument: that the optics are of, None where they are given alone.
        stride: thinning of the raster; every datum stands for stride^2.
    """

    signal: np.ndarray
    variance: np.ndarray
    optics: Optics
    tilt_std: float
    discrepancy_std: float
    geometry: GeometryPrior
    raster: Raster
    reconstruct_settings: ReconstructSettings
    order: ScanOrder
    is_level_held: bool
    is_level_free: bool
    held_level: float
    anchors: Anchors
    region: np.ndarray
    drift_modes: np.ndarray
    median_signal: np.ndarray
    slope_noise: float
    patches: AlbedoPatches
    parallax: np.ndarray
    parallax_height: np.ndarray
    noise_share: np.ndarray | None = None
    walls: tuple[np.ndarray, np.ndarray] | None = None
    off_substrate: np.ndarray | None = None
    instrument: Instrument | None = None
    stride: int = 1

    @classmethod
    def of(
        cls,
        signal: np.ndarray,
        variance: np.ndarray,
        instrument: Instrument | Optics,
        raster: Raster,
        start: Surface,
        settings: ReconstructSettings,
        region: np.ndarray | None = None,
        order: ScanOrder = ScanOrder(),
        uncertainty: Uncertainty | None = None,
        patches: AlbedoPatches | None = None,
        anchors: Anchors | None = None,
        parallax: tuple[np.ndarray, np.ndarray] | None = None,
        noise_share: np.ndarray | None = None,
        walls: tuple[np.ndarray, np.ndarray] | None = None,
        off_substrate: np.ndarray | None = None,
    ) -> "FitProblem":
        """Pose the problem; `start` fixes the level that is held, where the settings ask for it.

        `uncertainty` replaces the instrument's; optics alone are known exactly by default. Default of `patches`: none;
        of `parallax` (`parallax_of`): one beam.
        """
        given, optics = (None, instrument) if isinstance(instrument, Optics) else (instrument, Optics.of(instrument))
        stated = uncertainty or (Uncertainty() if given is None else given.uncertainty)
        if given is None or uncertainty is not None:
            geometry = GeometryPrior.of_uncertainty(stated, len(signal))
        else:
            geometry = GeometryPrior.of(given)
        s, shape = settings.refine, signal.shape[1:]
        check_law(s, None if given is None else given.law, len(signal))
        is_free = settings.border == "free"
        is_held = is_free and s.level_std_um is not None
        modes = drift_modes(shape, order, s.drift_degrees) if s.drift_std else np.zeros((1, 0, *shape))
        median = typical_signals(signal)
        noise = float(np.clip(np.sqrt(np.nanmedian(variance / median[:, None, None] ** 2)), 1e-3, 1.0))
        problem = cls(
            signal, variance, optics, math.radians(stated.tilt_deg), stated.discrepancy, geometry, raster, settings,
            order, is_held, is_free and not is_held, 0.0, anchors or Anchors.none(shape),
            np.zeros(shape, int) if region is None else region, modes, median, noise,
            patches or AlbedoPatches.none(shape), *(parallax or (np.zeros(signal.shape), np.zeros(shape))),
            noise_share, walls, off_substrate, given,
        )  # fmt: skip
        return replace(problem, held_level=float(np.sum(problem.level_weight * start.height)))

    @property
    def settings(self) -> RefineSettings:
        """Settings of the fit."""
        return self.reconstruct_settings.refine

    @property
    def pixel_noise(self) -> float | np.ndarray:
        """Slope noise of one pixel, or of every pixel [y, x] where dwell times differ."""
        return self.slope_noise if self.noise_share is None else self.slope_noise * self.noise_share

    @property
    def shift(self) -> np.ndarray:
        """Beam shift [2]."""
        return np.asarray(self.optics.beam_shift)

    @property
    def is_observed(self) -> np.ndarray:
        """Where there are data [detector, y, x]."""
        return np.isfinite(self.signal)

    @property
    def data(self) -> np.ndarray:
        """The signal, 0 where not observed [detector, y, x]."""
        return np.where(self.is_observed, self.signal, 0.0)

    @property
    def has_enough_images(self) -> np.ndarray:
        """Where enough images show the surface [y, x]."""
        return self.is_observed.sum(0) >= MIN_IMAGES

    @property
    def level_weight(self) -> np.ndarray:
        """Weights [y, x] of the mean height over its standard deviation, or 0 where nothing holds it."""
        enough = self.has_enough_images
        return self.is_level_held * enough / np.maximum(enough.sum(), 1) / LEVEL_STD

    @property
    def all_anchors(self) -> Anchors:
        """The anchors, with the held mean height."""
        held = Anchors(self.level_weight[None], np.array([self.held_level]))
        return held.and_also(self.anchors) if self.is_level_held else self.anchors

    @property
    def border(self) -> np.ndarray:
        """Prior weight of each height above the substrate [y, x], 1/um."""
        weight = _border_weight(self.raster.shape, self.reconstruct_settings)
        if self.off_substrate is None or self.reconstruct_settings.border != "flat":
            return weight
        return np.where(self.off_substrate, _BARELY_HELD, weight)

    @property
    def position(self) -> np.ndarray:
        """Positions (x, y) about the middle of the raster [2, y, x], um."""
        return self.raster.centred_positions()

    @property
    def geometry_prior(self) -> GeometryPrior:
        """Prior of distance and directions, where a held level stands for the distance."""
        held = self.settings.level_std_um if self.is_level_held else None
        return self.geometry.with_distance(held) if held else self.geometry

    @property
    def distance_std(self) -> float:
        """Prior standard deviation of the sample distance [um]."""
        return self.geometry_prior.distance_std

    @property
    def law_prior(self) -> LawPrior | None:
        """Prior of the scattering law; None: the cosine law."""
        return law_prior(self.settings, None if self.instrument is None else self.instrument.law)

    @property
    def is_law_held(self) -> bool:
        """Whether the scattering law is that of the instrument file, whose number is not fitted."""
        return self.law_prior is not None and not self.settings.has_own_law

    @property
    def held(self) -> tuple[str, ...]:
        """Names of the parameters of the instrument that are held as stated."""
        return ("law",) if self.is_law_held else ()

    @property
    def priors(self) -> Priors:
        """Prior standard deviations of the parameters."""
        s, median = self.settings, self.median_signal
        free = [bool(self.distance_std), *[self.geometry.is_aimed] * 2 * len(self.signal)]
        numbers = {
            "gain": s.gain_std,
            "offset": s.offset_std * median,
            "multiple": s.multiple_error,
            "albedo": s.albedo_std,
            "drift": s.drift_std * median,
            "discrepancy": self.discrepancy_std * median,
            "lines": s.line_std * median,
            "geometry": self.geometry_prior.factor()[np.ix_(free, free)],
            "tilt": self.tilt_std,
            "patch": s.patch_albedo_std,
        }
        return Priors(law=self.law_prior, **{name: np.asarray(value, float) for name, value in numbers.items()})

    def prior_means(self) -> Parameters:
        """Make the parameters at their prior means, all 0; those that are known have no entries."""
        s = self.settings
        k, n = self.signal.shape[0], s.albedo_modes if s.albedo_std else 0
        lines = self.signal.shape[1 + self.order.slow_axis] if s.line_std else 0
        shapes = {
            "log_gain": k,
            "offset": k,
            "log_multiple": k,
            "occluded": (),
            "surroundings": 1 if self.reconstruct_settings.border == "free" else 0,
            "albedo": (n, n),
            "drift": (k, self.drift_modes.shape[1]),
            "discrepancy": (k, s.discrepancy_modes, s.discrepancy_modes) if self.discrepancy_std else 0,
            "lines": (k, lines),
            "law": len(numbers_of(self.law_prior)),
            "distance": 1 if s.geometry and self.distance_std else 0,
            "tilt": 2 if s.geometry and self.tilt_std else 0,
            "aim": (k, 2) if s.geometry and self.geometry.is_aimed else 0,
            "patch": len(self.patches.members),
        }
        return Parameters(**{name: np.zeros(shape) for name, shape in shapes.items()})

    def stated_parameters(self) -> Parameters:
        """Make the parameters of what is stated: prior means, and the albedos of the patches as found."""
        means, found = self.prior_means(), self.patches.log_albedo
        return means.replaced(patch=np.pad(found, (0, means.patch.size - found.size)) / self.settings.patch_albedo_std)

    def start_parameters(self) -> Parameters:
        """Make the parameters that fits and searches start from: as stated, or gains and offsets by the border.

        Where the level of a flat border is off, they share what explains it, by their priors.
        """
        of_sample = self.signal / self.patches.albedo
        level = border_levels(of_sample, self.optics, self.reconstruct_settings, self.law_prior)
        gain_std, expected = self.settings.gain_std, border_signal(self.optics, self.law_prior)
        offset_std = self.priors.offset / expected
        offset = (level - 1.0) * offset_std / (offset_std**2 + gain_std**2)
        log_gain = np.log(level - offset_std * offset) / gain_std
        return self.stated_parameters().replaced(log_gain=log_gain, offset=offset)

    def patches_at(self, parameters: Parameters) -> AlbedoPatches:
        """Return the patches with the albedos of parameters."""
        return self.patches.with_albedo(self.settings.patch_albedo_std * np.asarray(parameters.patch))

    def albedo_at(self, parameters: Parameters) -> np.ndarray:
        """Compute the albedo of every pixel [y, x], smooth and by patches, relative to the substrate's."""
        if not parameters.albedo.size:
            return self.patches_at(parameters).albedo
        with jax.enable_x64(True):
            modes = jnp.asarray(parameters.albedo)
            smooth = np.asarray(smooth_albedo(modes, self.signal.shape[1:], self.settings.albedo_std))
        return smooth * self.patches_at(parameters).albedo

    def law_at(self, parameters: Parameters) -> Law | None:
        """Return the scattering law of parameters, of NumPy numbers; None: the cosine law."""
        with jax.enable_x64(True):
            return jax.tree.map(np.asarray, law_of(parameters, self.priors))

    def known_law(self, parameters: Parameters) -> dict[str, Law]:
        """Keywords by which a prediction is given the law; none for the cosine law."""
        law = self.law_at(parameters)
        return {} if law is None else {"law": law}

    def known_tilt(self, parameters: Parameters) -> dict[str, tuple[float, float]]:
        """Keywords by which a prediction is given the substrate's slopes; none where it is known to be level."""
        slopes = self.tilt_std * np.asarray(parameters.tilt)
        return {"tilt": (float(slopes[0]), float(slopes[1]))} if slopes.size else {}

    @property
    def is_instrument_unknown(self) -> bool:
        """Whether more is unknown of the instrument than gains and offsets: drift or geometry."""
        p = self.prior_means()
        return bool(p.distance.size or p.aim.size or p.drift.shape[1])

    @property
    def follows_relief(self) -> bool:
        """Whether corrections follow level, scale and tilt of all heights, which no border holds."""
        return self.is_level_free or self.is_level_held

    @property
    def is_biased_by_noise(self) -> bool:
        """Whether the noise of the slopes moves a combination of heights and instrument by its error bar.

        A flat border alone holds the level, but not against an unknown drift, which the relief resembles.
        """
        return self.is_level_free or bool(self.settings.drift_std)

    def moves(self, parameters: Parameters) -> np.ndarray:
        """Compute distance [um], polar angle and azimuth [rad] beyond the stated ones [move, detector]."""
        with jax.enable_x64(True):
            return np.asarray(moves_of(jax.tree.map(jnp.asarray, parameters), self.priors, len(self.signal)))

    def fitted_instrument(self, parameters: Parameters) -> Instrument:
        """Move the instrument by what parameters stand for."""
        assert self.instrument is not None  # of a measurement
        moves = self.moves(parameters)
        return self.instrument.moved(moves[1:].T, float(moves[0, 0])) if len(moves) else self.instrument

    @property
    def is_parted(self) -> np.ndarray:
        """Pixels that walls separate from all but a few others [y, x]."""
        if self.walls is None:
            return np.zeros(self.raster.shape, bool)
        region = regions(*(~wall for wall in self.walls))
        return np.bincount(region.ravel())[region] < MIN_REGION

    def within_neighbours(self, surface: Surface) -> Surface:
        """Keep the heights of parted pixels, which little determines, between those of their neighbours."""
        is_parted = self.is_parted
        if not is_parted.any():
            return surface
        low, high = (np.where(is_parted, outside, surface.height) for outside in (np.inf, -np.inf))
        low, high = minimum_filter(low, 3, mode="nearest"), maximum_filter(high, 3, mode="nearest")
        height = np.where(is_parted & (low <= high), np.clip(surface.height, low, high), surface.height)
        return Surface(height, surface.slope_x, surface.slope_y)

    def thinned(self, stride: int) -> "FitProblem":
        """Keep every `stride`-th row and column, each standing for stride^2 data."""
        if stride == 1:
            return self
        thin = (slice(None, None, stride),) * 2
        return replace(
            self,
            signal=self.signal[:, *thin],
            variance=self.variance[:, *thin],
            raster=Raster.regular(self.signal[0][thin].shape, self.raster.dx * stride, self.raster.dy * stride),
            order=self.order.thinned(thin),
            anchors=self.anchors.thinned(thin),
            region=self.region[thin],
            patches=self.patches.thinned(thin),
            drift_modes=self.drift_modes[:, :, *thin],
            parallax=self.parallax[:, *thin],
            parallax_height=self.parallax_height[thin],
            noise_share=None if self.noise_share is None else self.noise_share[thin],
            walls=None if self.walls is None else thinned_walls(*self.walls, stride),
            off_substrate=None if self.off_substrate is None else self.off_substrate[thin],
            stride=stride,
        )


def _border_weight(shape: tuple[int, ...], settings: ReconstructSettings) -> np.ndarray:
    """Compute the prior weight of each height: the border is flat, or just the mean height is held.

    The outermost ring is enough to level the heights; drift needs all of the border to be distinguished from relief.
    """
    weight = np.full(shape, _BARELY_HELD)
    if settings.border == "flat":
        width = settings.border_fraction if settings.refine.drift_std > 0 else 1.0 / max(shape)
        weight[border_mask((shape[0], shape[1]), width)] = 1.0 / settings.border_std_um
    else:
        weight[:] = 1e-3 / settings.border_std_um / np.sqrt(weight.size)
    return weight


def thinned_walls(along_x: np.ndarray, along_y: np.ndarray, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """Keep the walls between every `stride`-th pixel of every `stride`-th row or column."""
    x, y = along_x[::stride], along_y[:, ::stride]
    x, y = x[:, : (x.shape[1] // stride) * stride], y[: (y.shape[0] // stride) * stride]
    by_x, by_y = x.reshape(len(x), -1, stride), y.reshape(-1, stride, y.shape[1])
    return np.asarray(by_x.any(2)), np.asarray(by_y.any(1))
