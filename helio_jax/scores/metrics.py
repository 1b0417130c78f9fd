"""Scores of a reconstruction against a known surface: height, shape and slope errors, calibration of the error bars.

Heights are compared in the beam frame, pixel by pixel, with the true first hit of the same ray. A piston is removed
before, because the level is not measured; nothing else is fitted, except the centre of a measured sphere. The region of
a pixel follows from its TRUE height, so that no error can move it out of the region.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from helio_jax.arrays import as_float_array, border_mask, pitch
from helio_jax.errors import GuardError, InputFileError, SceneError
from helio_jax.reconstruction import Reconstruction

RING_FRACTION = 0.15
"""Width of the rim ring inside the region, where masking and depth jumps are, as a fraction of its radius."""
BORDER_FRACTION = 0.05
"""Width of the frame that sets the level without a region, as a fraction of the raster's width."""


@dataclass(frozen=True)
class Region:
    """Scoring region of a sphere or another feature on a substrate, sample frame (frozen, checked when made).

    Attributes:
        height: known height H of the feature above the substrate [um]; errors are given as fractions of it.
        center: axis of the feature (x, y) [um].
        radius: pixels whose true first hit lies within this distance of the axis are scored [um].
        substrate_radius: beyond this distance lies the substrate, which sets the level [um], >= radius.
    """

    height: float
    center: tuple[float, float] = (0.0, 0.0)
    radius: float = 1050.0
    substrate_radius: float = 1400.0

    def __post_init__(self) -> None:
        for name, value in (("height", self.height), ("radius", self.radius)):
            if not 0 < value < np.inf:
                raise SceneError(f"the scored region's {name} must be > 0 um and finite, got {value:g}")
        if not self.substrate_radius >= self.radius:
            raise SceneError(
                f"substrate_radius must be >= radius = {self.radius:g} um, got {self.substrate_radius:g}: the level "
                "must be taken outside the scored region"
            )


@dataclass(frozen=True)
class Truth:
    """The true surface seen by the beam, pixel by pixel (frozen, checked when made).

    Attributes:
        height: true height of the first hit of each pixel's ray [y, x], um; NaN where the ray meets nothing.
        normals: true unit normals there, up [y, x, 3], or None.
        region: of a feature on a substrate, or None: every pixel is scored.
    """

    height: np.ndarray
    normals: np.ndarray | None = None
    region: Region | None = None

    def __post_init__(self) -> None:
        height = as_float_array("true height", self.height, (None, None), InputFileError)
        object.__setattr__(self, "height", height)
        if self.normals is not None:
            normals = as_float_array("true normals", self.normals, (*height.shape, 3), InputFileError)
            object.__setattr__(self, "normals", normals)


SCORE_ROWS: dict[str, tuple[str, str, float, int]] = {
    "recovered_height": ("height recovered at the true apex", "%", 100.0, 1),
    "recovered_height_um": ("height at the true apex", "um", 1.0, 1),
    "recovered_height_std_um": ("its standard deviation", "um", 1.0, 2),
    "rms_region": ("RMS error, sample region", "%", 100.0, 2),
    "rms_image": ("RMS error, whole image", "%", 100.0, 2),
    "rms_valid": ("RMS error, valid pixels", "%", 100.0, 2),
    "ring_error": ("RMS error, rim ring", "%", 100.0, 2),
    "shape_error": ("shape error, sample region", "%", 100.0, 2),
    "mean_error": ("mean error", "%", 100.0, 2),
    "lowest_error": ("lowest error", "%", 100.0, 1),
    "highest_error": ("highest error", "%", 100.0, 1),
    "p95_error": ("95th percentile of |error|", "%", 100.0, 2),
    "max_error": ("largest |error|", "%", 100.0, 1),
    "slope_rms": ("RMS angle between normals", "deg", 180.0 / np.pi, 2),
    "slope_median": ("median angle between normals", "deg", 180.0 / np.pi, 2),
    "pull_mean": ("mean of error / std", "", 1.0, 2),
    "pull_std": ("standard deviation of error / std", "", 1.0, 2),
    "coverage_1": ("errors within 1 std (68.3 expected)", "%", 100.0, 1),
    "coverage_2": ("errors within 2 std (95.4 expected)", "%", 100.0, 1),
    "valid_fraction": ("valid pixels", "%", 100.0, 1),
    "n_pixels": ("pixels scored in the region", "", 1.0, 0),
    "level_um": ("level removed", "um", 1.0, 2),
    "H_um": ("known height H", "um", 1.0, 1),
}
"""For every score: label, unit shown, factor to that unit, decimals. Percentages are of H, or of pixels."""


@dataclass(frozen=True)
class Scores:
    """Errors of one reconstruction; error = reconstructed height - true height - level. None: not defined here.

    "Region" is `Truth.region`, or all scored pixels without one. Pixels without a finite height in the reconstruction
    or in the truth are excluded; `n_pixels` and `valid_fraction` count the others.

    Attributes:
        rms_region: sqrt(mean(error^2)) / H over the region, valid or not.
        rms_image: the same over all pixels.
        rms_valid: the same over all pixels with `is_valid`.
        ring_error: the same over the outer `RING_FRACTION` of the region; None without a region.
        shape_error: the same over the region after z -> a z + b, with the substrate at its true height and the extreme
            reconstructed height in the region at the known one (not fitted).
        recovered_height: reconstructed height at the pixel of the true apex, over H.
        recovered_height_um, recovered_height_std_um: that height, and `height_std` there [um].
        mean_error, lowest_error, highest_error: of error / H over the region.
        p95_error, max_error: 95th percentile and maximum of |error| / H over the region.
        slope_rms, slope_median: angle between reconstructed and true normals, region [rad]; None without true normals.
        pull_mean, pull_std: of error / height_std over valid pixels; 0 and 1 for correct normal error bars.
        coverage_1, coverage_2: fraction of valid pixels with |error| <= 1 (2) height_std; 0.683 (0.954) likewise.
        valid_fraction: fraction of all pixels that are valid and have a height.
        n_pixels: number of pixels scored in the region.
        level_um: piston subtracted from the reconstructed heights [um].
        H_um: height that the errors are fractions of [um].
    """

    rms_region: float
    rms_image: float
    rms_valid: float | None
    ring_error: float | None
    shape_error: float | None
    recovered_height: float | None
    recovered_height_um: float | None
    recovered_height_std_um: float | None
    mean_error: float
    lowest_error: float
    highest_error: float
    p95_error: float
    max_error: float
    slope_rms: float | None
    slope_median: float | None
    pull_mean: float | None
    pull_std: float | None
    coverage_1: float | None
    coverage_2: float | None
    valid_fraction: float
    n_pixels: int
    level_um: float
    H_um: float

    def as_dict(self) -> dict[str, float | int | None]:
        """Return the scores as JSON-compatible numbers (None where not defined)."""
        return asdict(self)

    def as_table(self, names: Sequence[str] = tuple(SCORE_ROWS)) -> list[tuple[str, str, str]]:
        """Format rows (label, value, unit) of the defined scores."""
        known = [name for name in names if getattr(self, name) is not None]
        return [(SCORE_ROWS[n][0], format_score(n, getattr(self, n)), SCORE_ROWS[n][1]) for n in known]


def format_score(name: str, value: float) -> str:
    """Format a score in the unit and with the decimals of `SCORE_ROWS`."""
    _, _, factor, decimals = SCORE_ROWS[name]
    return f"{value * factor:.{decimals}f}"


def axis_distance(rec: Reconstruction, true_height: np.ndarray, center: tuple[float, float]) -> np.ndarray:
    """Compute the distance of each pixel's true first hit from the vertical axis at `center` [y, x], um.

    Source: docs/conventions.md, Frames and units: a point of height h seen in pixel (X, Y) lies at (X - h tan t, Y).
    """
    x, y = rec.instrument.surface_position(rec.raster_x[None, :], rec.raster_y[:, None], true_height)
    return np.hypot(x - center[0], y - center[1])


def flat_mask(rec: Reconstruction, truth: Truth) -> np.ndarray:
    """Mark the pixels that set the level: the substrate beyond the region, or the raster's border [y, x]."""
    if truth.region is None:
        return border_mask(rec.height.shape, BORDER_FRACTION)  # type: ignore[arg-type]
    return axis_distance(rec, truth.height, truth.region.center) > truth.region.substrate_radius


def _levels(rec: Reconstruction, truth: Truth, is_scored: np.ndarray) -> tuple[float, float]:
    """Compute the reconstructed level of the substrate minus the true one, and the true one [um].

    On a substrate: difference of the medians. On a border, which may hold several planes (a step, a trench): median of
    the differences.
    """
    use = flat_mask(rec, truth) & is_scored
    if not use.any():
        limit = "the border" if truth.region is None else f"beyond {truth.region.substrate_radius:g} um of the axis"
        raise GuardError(
            f"the level needs pixels of the substrate, got none {limit}: enlarge the scan or reduce substrate_radius"
        )
    base = float(np.median(truth.height[use]))
    if truth.region is None:
        return float(np.median(rec.height[use] - truth.height[use])), base
    return float(np.median(rec.height[use])) - base, base


def height_error(rec: Reconstruction, truth: Truth) -> tuple[np.ndarray, float]:
    """Compute the levelled height error [y, x], um; return it and the removed level [um].

    Raises:
        InputFileError: the truth has another raster.
        GuardError: no pixel has both heights, or none lies on the substrate.
    """
    if truth.height.shape != rec.height.shape:
        raise InputFileError(
            f"true height must have the shape {rec.height.shape} of the reconstruction, got {truth.height.shape}: "
            "trace it on the same raster"
        )
    is_scored = np.isfinite(rec.height) & np.isfinite(truth.height)
    if not is_scored.any():
        raise GuardError("no pixel has both a reconstructed and a true height: the two have nothing in common")
    level, _ = _levels(rec, truth, is_scored)
    return rec.height - level - truth.height, level


def normal_angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute the angle between unit vectors [...], rad; accurate for small angles, too (atan2 of cross and dot)."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def _rms(values: np.ndarray) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if values.size else None


def _height_scores(
    rec: Reconstruction, truth: Truth, height: np.ndarray, region: np.ndarray, base: float, H: float
) -> dict[str, float | None]:
    """Compute the recovered-height scores and the shape error; `height` is the levelled reconstruction.

    The height at the apex is divided by the known H, or, without a region, by the true extreme's distance to the base.
    """
    true = truth.height
    sign = 1.0 if np.max(true[region]) - base >= base - np.min(true[region]) else -1.0
    apex = np.unravel_index(np.argmax(np.where(region, sign * (true - base), -np.inf)), true.shape)
    known = H if truth.region else float(sign * (true[apex] - base))
    recovered = float(sign * (height[apex] - base))
    peak = float(np.max(sign * (height[region] - base)))
    stretched = base + (height[region] - base) * (known / peak) if peak > 0 else np.empty(0)
    std = np.nan if rec.height_std is None else float(rec.height_std[apex])
    return {
        "recovered_height": recovered / known if known > 0 else None,
        "recovered_height_um": recovered,
        "recovered_height_std_um": std if np.isfinite(std) else None,
        "shape_error": _rms((stretched - true[region]) / H) if stretched.size else None,
    }


def _slope_scores(rec: Reconstruction, truth: Truth, region: np.ndarray) -> dict[str, float | None]:
    if truth.normals is None:
        return {"slope_rms": None, "slope_median": None}
    angle = normal_angle(rec.normals[region], truth.normals[region])
    angle = angle[np.isfinite(angle)]
    return {"slope_rms": _rms(angle), "slope_median": float(np.median(angle)) if angle.size else None}


def _pull_scores(rec: Reconstruction, error: np.ndarray) -> dict[str, float | None]:
    """Compute mean and standard deviation of error / height_std and its coverage, over valid pixels."""
    names = ("pull_mean", "pull_std", "coverage_1", "coverage_2")
    if rec.height_std is None:
        return dict.fromkeys(names)
    use = rec.is_valid & np.isfinite(error) & np.isfinite(rec.height_std) & (rec.height_std > 0)
    if not use.any():
        return dict.fromkeys(names)
    pull = error[use] / rec.height_std[use]
    numbers = (pull.mean(), pull.std(), np.mean(np.abs(pull) <= 1), np.mean(np.abs(pull) <= 2))
    return dict(zip(names, map(float, numbers), strict=True))


def evaluate_height(rec: Reconstruction, truth: Truth) -> Scores:
    """Score a reconstruction against the truth.

    Valid for one raster in the beam frame. With a region: H is its known height, and the level is the median of the
    reconstructed minus that of the true substrate beyond the substrate radius. Without: every pixel is scored, H is the
    range of the true heights, and the level is the median difference on the raster's border.

    Raises:
        InputFileError: the truth has another raster.
        GuardError: no common pixel, no substrate, an empty region, or a truth without any height range.

    Source: A. Radić et al., arXiv 2501.14833 (RMS and shape error, with the square missing in its formula).
    """
    error, level = height_error(rec, truth)
    is_scored = np.isfinite(error)
    _, base = _levels(rec, truth, is_scored)
    region, ring, H = is_scored, None, float(np.ptp(truth.height[is_scored]))
    if truth.region is not None:
        r, H = axis_distance(rec, truth.height, truth.region.center), truth.region.height
        region = is_scored & (r <= truth.region.radius)
        ring = region & (r >= (1 - RING_FRACTION) * truth.region.radius)
    if not region.any() or H <= 0:
        raise GuardError(
            f"the scored region holds {int(region.sum())} pixels and the true heights range over {H:g} um; both must "
            "be > 0: check the region's centre and radius against the raster"
        )
    part, relative = error[region] / H, error / H
    return Scores(
        rms_region=float(np.sqrt(np.mean(part**2))),
        rms_image=float(np.sqrt(np.mean(relative[is_scored] ** 2))),
        rms_valid=_rms(relative[is_scored & rec.is_valid]),
        ring_error=None if ring is None else _rms(relative[ring]),
        mean_error=float(part.mean()),
        lowest_error=float(part.min()),
        highest_error=float(part.max()),
        p95_error=float(np.percentile(np.abs(part), 95)),
        max_error=float(np.abs(part).max()),
        **_height_scores(rec, truth, rec.height - level, region, base, H),
        **_slope_scores(rec, truth, region),
        **_pull_scores(rec, error),
        valid_fraction=float(np.mean(rec.is_valid & np.isfinite(rec.height))),
        n_pixels=int(region.sum()),
        level_um=level,
        H_um=H,
    )


def fit_center(
    rec: Reconstruction, true_height_of: Callable[[float, float], np.ndarray], start: Region, *, reach_um: float = 300.0
) -> Region:
    """Find the centre of a measured sphere, whose radius and height are taken as nominal.

    Minimises the mean of the robust residual sqrt(1 + (error / s)^2) - 1, s = 2 % of H, over the region, which moves
    with the centre: first on a grid of 5 x 5 centres, then by Nelder-Mead to 0.01 raster pitches. Valid when the start
    is within `reach_um` of the centre in x and in y.

    Args:
        rec: the reconstruction.
        true_height_of: heights [y, x] um of the first hits for a sphere centred at (x, y) um, beam frame.
        start: the region, with the first guess of the centre.
        reach_um: largest shift searched in x and y [um], > 0.

    Returns:
        The region with the fitted centre.

    Raises:
        GuardError: the best centre lies at the edge of the search, or the search does not converge.

    Source: own choice, tests/unit/test_metrics.py.
    """
    from scipy.optimize import minimize

    scale = 0.02 * start.height
    smallest = min(pitch(rec.raster_x), pitch(rec.raster_y))

    def cost(center: Sequence[float]) -> float:
        region = replace(start, center=(float(center[0]), float(center[1])))
        truth = Truth(true_height_of(*region.center), region=region)
        error, _ = height_error(rec, truth)
        use = np.isfinite(error) & (axis_distance(rec, truth.height, region.center) <= region.radius)
        return float(np.mean(np.sqrt(1 + (error[use] / scale) ** 2) - 1)) if use.any() else np.inf

    x0, y0 = start.center
    shifts = np.linspace(-reach_um, reach_um, 5)
    grid = [(x0 + dx, y0 + dy) for dy in shifts for dx in shifts]
    first = np.array(min(grid, key=cost))
    simplex = first + 0.25 * reach_um * np.array([[0, 0], [1, 0], [0, 1]])
    # only xatol stops: the cost jumps as pixels enter and leave the region
    options = {"initial_simplex": simplex, "xatol": 0.01 * smallest, "fatol": np.inf, "maxiter": 400}
    best = minimize(cost, first, method="Nelder-Mead", options=options)
    moved = np.abs(best.x - start.center).max()
    if not best.success or moved > reach_um:
        raise GuardError(
            f"the sphere's centre was not found within {reach_um:g} um of {start.center} um (best {best.x.round(1)} "
            f"um, {best.message}): state a centre that is nearer"
        )
    return replace(start, center=(float(best.x[0]), float(best.x[1])))
