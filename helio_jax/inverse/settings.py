"""Settings of the reconstruction: table `[reconstruct]`. Read by the command line without importing JAX."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from helio_jax.inverse.anchor_settings import AnchorSettings
from helio_jax.settings import Settings

PATHS_PER_PIXEL, LEAST_PATHS = 100, 3_000_000
"""Default paths per prediction of the multiple scattering: with 14 per pixel their noise on the flat about sphere A was
1.4 to 2.6 times that of 35 000 atoms per pixel (both averaged over 4 pixels), and the flat rose towards the sphere. In
a slot (41 x 41) heights were 3 % off with a million paths, and right with 3 million."""
START_THRIFT = 4
"""So many times fewer for photometric solutions, but not fewer than the least number: from a noisier start the rim of
sphere B is 7 % worse."""
SEARCH_THRIFT = 8
"""So many times fewer in a search and in the test of a fit."""


class RefineSettings(Settings):
    """The fit of the heights: table `[reconstruct.refine]`."""

    max_rounds: int = Field(default=8, ge=1, le=50)
    """Outer iterations: how often masks and multiple scattering are predicted on the current surface."""
    tolerance_um: float = Field(default=1.0, gt=0.0, le=1e3)
    """The fit has converged when an outer iteration changes the heights by less than this (root mean square) [um]."""
    gain_std: float = Field(default=0.02, gt=0.0, le=1.0)
    """Prior standard deviation of each detector's gain, relative."""
    offset_std: float = Field(default=0.01, gt=0.0, le=1.0)
    """Prior standard deviation of each detector's offset, relative to its median signal."""
    drift_std: float = Field(default=0.0, ge=0.0, le=10.0)
    """Prior standard deviation of each detector's slow drift, relative to its median signal; 0: no drift."""
    drift_degrees: tuple[Annotated[int, Field(ge=1, le=9)], Annotated[int, Field(ge=1, le=9)]] = (4, 3)
    """Largest degree of the drift's polynomials along the slow and the fast axis of the scan."""
    line_std: float = Field(default=0.0, ge=0.0, le=10.0)
    """Prior standard deviation of each scan line's own offset, relative to the median signal; 0: lines have none."""
    law: Literal["as_stated", "cosine", "power", "broad_specular", "rough_diffuse", "monotone"] = "as_stated"
    """Scattering law of the sample. `as_stated`: that of the instrument file's [law], which is not fitted, but whose
    standard deviation is in the error bars; the cosine law where it has none. `cosine`: known; the others have unknown
    numbers, about those of the cosine law. `power`: exponent m of cos^(1 + m); `broad_specular`: share and width of a
    lobe about the mirror's direction, the rest by the cosine law; `rough_diffuse`: roughness r of the energy-preserving
    Oren-Nayar model; `monotone`: any density that falls with the angle to the normal, by its exponent at 7 angles
    (needs 5 or more images)."""
    law_std: float = Field(default=0.3, gt=0.0, le=1.0)
    """Prior standard deviation of m, of the lobe's share, of r, or of the logarithm of each of the 7 exponents."""
    law_width_deg: float = Field(default=30.0, ge=5.0, le=90.0)
    """Prior mean of the lobe's width [deg]."""
    law_width_std_deg: float = Field(default=10.0, gt=0.0, le=90.0)
    """Prior standard deviation of the lobe's width [deg]."""
    geometry: bool = True
    """Whether distance, tilt and aperture angles are unknowns where the instrument's [uncertainty] states them."""
    level_std_um: float | None = Field(default=None, gt=0.0, le=1e5)
    """With a free border: the mean height stays where the fit starts, and the distance from there to the plate is an
    unknown of this prior standard deviation [um]; the relief's scale goes with it. Default: the level is unknown."""
    albedo_std: float = Field(default=0.0, ge=0.0, le=1.0)
    """Prior standard deviation of the smooth relative albedo; 0: the albedo is constant."""
    albedo_modes: int = Field(default=6, ge=1, le=64)
    """Cosine modes of the albedo per axis."""
    discrepancy_modes: int = Field(default=6, ge=2, le=32)
    """Cosine modes per axis of what the model lacks in each detector's image, where the instrument's [uncertainty]
    states a `discrepancy`."""
    patch_albedo_std: float = Field(default=0.3, gt=0.0, le=2.0)
    """Prior standard deviation of the log albedo of patches, objects of other albedo than the substrate's."""
    albedo_patches: bool = True
    """Whether such patches are looked for; what is found is fitted where it explains the images better."""
    substrate_um: float | None = Field(default=None, gt=0.0, le=1e6)
    """Side of the substrate that scatters around the image [um]; default: as far beyond each border as the outermost
    aperture reaches, and once more the plate's distance."""
    mask_error: float = Field(default=0.15, ge=0.0, le=10.0)
    """Assumed relative error of the predicted masked signal; masked data are down-weighted by it."""
    multiple_error: float = Field(default=0.1, ge=0.0, le=10.0)
    """Assumed relative error of the predicted multiple scattering."""
    error_reach: float = Field(default=0.06, ge=0.0, le=1.0)
    """Error bars: correlation length of those two errors, as a share of the range of heights."""
    robust_limits: tuple[float, ...] = Field(default=(10.0, 10.0, 8.0), min_length=1, max_length=20)
    """Residuals [standard deviations] at which a datum's weight falls to a half, for each re-weighting of the first
    iteration."""
    jump_limits: tuple[float, ...] = Field(default=(5.0, 4.0, 4.0), min_length=1, max_length=20)
    """Misfits [standard deviations] at which an edge between two pixels loses most of its weight: a depth jump."""
    fixed_rounds: int = Field(default=1, ge=0, le=50)
    """Outer iterations during which gain and offset stay at their prior means, while the prediction is still crude;
    none where drift or geometry are unknown: heights fitted to a wrong geometry would close depth jumps for good."""
    reweightings: int = Field(default=2, ge=1, le=100)
    """Re-weightings in every later iteration, with the last limits."""
    photometric_rounds: int = Field(default=4, ge=1, le=20)
    """Photometric solutions, each corrected by a prediction on the last, before the fit."""
    lm_steps: int = Field(default=4, ge=1, le=1000)
    """Gauss-Newton steps per re-weighting."""
    cg_steps: int = Field(default=40, ge=1, le=10_000)
    """Conjugate-gradient steps per Gauss-Newton step; truncating them regularises."""
    objects: bool = True
    """Whether pits in a flat substrate and objects on it are looked for where the data contradict a fit; what is found
    is kept where it explains the images better. Only with a flat border."""
    bias_pairs: int = Field(default=4, ge=0, le=1000)
    """Pairs of fits to simulated data, of opposite noise, that estimate the bias by noise; only with a free border or
    an unknown drift. A pair takes about as long as two outer iterations."""
    samples: int = Field(default=32, ge=0, le=10_000)
    """Samples of the posterior, from which the standard deviation of every height is taken; 0: no error bars."""
    multiple: Literal["traced", "radiosity"] = "traced"
    """Model of the multiple scattering: `traced` follows paths; `radiosity` is noise-free but takes one value per pixel
    (`forward/radiosity.py`), so it differs by some per cent beside depth jumps."""
    rays: int | None = Field(default=None, ge=1000, le=10**10)
    """Paths per traced prediction of the multiple scattering, over the whole image, whose noise it shall have; default:
    100 per pixel, but 3 million at least. Up to ten times fewer are traced where they have the same noise because they
    are guided, but 8 from each pixel at least (for each beam and each way in which a free border is continued)."""

    def paths(self, n_pixels: int) -> int:
        """Number of paths of a prediction for so many pixels."""
        return max(LEAST_PATHS, PATHS_PER_PIXEL * n_pixels) if self.rays is None else self.rays

    def start_paths(self, n_pixels: int) -> int:
        """Number of paths of a prediction on a photometric solution."""
        n_paths = self.paths(n_pixels)
        return min(n_paths, max(n_paths // START_THRIFT, LEAST_PATHS))

    def search_paths(self, n_pixels: int) -> int:
        """Number of paths of a prediction in a search and in the test of a fit."""
        return max(self.paths(n_pixels) // SEARCH_THRIFT, 1000)

    def law_of_fit(self, is_stated: bool) -> str:
        """Name the law that a fit takes; `is_stated`: whether the instrument file has a table [law]."""
        return self.law if self.law != "as_stated" else "power" if is_stated else "cosine"

    @property
    def has_own_law(self) -> bool:
        """Whether these settings name a law with unknown numbers."""
        return self.law not in ("as_stated", "cosine")

    @model_validator(mode="after")
    def _has_law(self) -> "RefineSettings":
        for key in ("law_std", "law_width_deg", "law_width_std_deg"):
            if not self.has_own_law and getattr(self, key) != RefineSettings.model_fields[key].default:
                raise ValueError(f"{key} has no use with the known cosine law: set law, too, e.g. law = 'power'")
        if self.has_own_law and self.multiple == "radiosity":
            raise ValueError(
                "multiple = 'radiosity' knows the cosine law only: set it to 'traced' where a law is fitted"
            )
        return self

    @model_validator(mode="after")
    def _has_matching_stages(self) -> "RefineSettings":
        n_robust, n_jump = len(self.robust_limits), len(self.jump_limits)
        if n_robust != n_jump:
            raise ValueError(f"robust_limits ({n_robust}) and jump_limits ({n_jump}) must be of the same length")
        return self


class ReconstructSettings(Settings):
    """How micrographs are turned into heights."""

    method: Literal["linear", "nearfield", "refine"] = "refine"
    """`linear`: constant detection directions (the paper's method); `nearfield`: directions follow the height;
    `refine`: fit of the heights through the render model, with masking, depth jumps and multiple scattering."""
    integrator: Literal["weighted", "dct_poisson", "harker_oleary", "bilateral"] = "weighted"
    """From slopes to heights: `weighted` cuts depth jumps; the others are kept for comparison."""
    rounds: int = Field(default=4, ge=1, le=100)
    """`nearfield`: how often the directions are evaluated at the current height."""
    damping: float = Field(default=0.8, gt=0.0, le=1.0)
    """`nearfield`: share of the new height in each iteration."""
    border: Literal["flat", "free"] = "flat"
    """Whether the border of the image lies on the substrate: levels the heights there."""
    border_fraction: float = Field(default=0.06, gt=0.0, lt=0.5)
    """Width of that border, as a fraction of the image on each side."""
    border_std_um: float = Field(default=2.0, gt=0.0, le=1e4)
    """`refine`: how flat the border is known to be [um]."""
    corrections: int = Field(default=1, ge=0, le=20)
    """`nearfield`: how often predicted masking and multiple scattering are subtracted from the data; 0: never."""
    samples: int = Field(default=16, ge=0, le=10_000)
    """`linear`, `nearfield`: how often noise and calibration are drawn for the error bars; 0: no error bars."""
    anchor: tuple[AnchorSettings, ...] = Field(default=(), max_length=200)
    """`refine`: what is known of the heights: places, steps, masks, the highest point."""
    refine: RefineSettings = RefineSettings()
