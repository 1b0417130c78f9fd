"""Plan an acquisition before it is made: time, SNR and errors of the heights for candidates of dwell, pixel and views.

What it takes: a scene, whose sample is what is expected, with [noise] dwell_s, move_s and flyback_s; or the times of a
measured scan. What it gives: for each candidate its time and the errors by Fisher's information (`hx.fisher`), and the
candidate that reaches a wanted error soonest; on request a simulation of it, reconstructed and compared.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.arguments import checked
from helio_jax.arrays import border_mask
from helio_jax.errors import GuardError, InputFileError, SceneError
from helio_jax.formats.acquisition import read_acquisitions
from helio_jax.forward.form_factor import substrate_signal
from helio_jax.forward.optics import Optics
from helio_jax.forward.optics import Raster as BeamPositions
from helio_jax.forward.surface import Surface, slopes_of_normal
from helio_jax.inverse.fisher import fisher
from helio_jax.inverse.linear import MIN_IMAGES
from helio_jax.planning.coverage import scans_per_pixel, shifts_about
from helio_jax.planning.timing import Timing, measure_move, seconds_per_height
from helio_jax.reconstruction import end_if_interrupted
from helio_jax.scene.scan import Raster
from helio_jax.scene.views import views_of
from helio_jax.workflows import pipeline
from helio_jax.workflows.scene_file import SceneFile
from helio_jax.workflows.truth import true_surface

N_SAMPLES = 128
"""Samples of the posterior: each standard deviation is known to 6 %, their root mean square to less."""


@dataclass(frozen=True)
class Candidate:
    """One way to acquire the images.

    Attributes:
        rotations_deg: rotation of the sample (or the detectors) in each scan [deg].
        n_images: images of all scans.
        pixel_size_um: as [scan] pixel_size_um.
        shape: rows and columns.
        dwell_s: counting time of a pixel [s].
        seconds: time of all scans [s].
        snr: signal of the bare substrate over its counting noise, of the weakest image.
        height_std_um: standard deviation of typical heights (`typical`), off the border, that all scans see.
        level_std_um: standard deviation of the mean height of the upper half of the relief above the substrate.
        seen_by_all: share of the first scan's pixels that all scans see.
        speed_up: time per reconstructed pixel that one detector would take for as many images, by even rotations of the
            sample about the middle of the field, over that of this candidate.
    """

    rotations_deg: tuple[float, ...]
    n_images: int
    pixel_size_um: float
    shape: tuple[int, int]
    dwell_s: float
    seconds: float
    snr: float
    height_std_um: float
    level_std_um: float
    seen_by_all: float
    speed_up: float


@dataclass(frozen=True)
class Check:
    """A candidate simulated, reconstructed and compared with the truth.

    Attributes:
        predicted_um: standard deviation of typical heights (`typical`) by `hx.fisher`, of the compared pixels.
        obtained_um: the same of the errors of the reconstructed heights, all draws of the noise together.
        scatter_um: the same of their deviations from the mean over the draws: without what is wrong in all draws; None
            with a single draw.
        stated_um: the same of the errors that the reconstructions state.
        rms_um: root mean square of the errors, which a few heights beside walls may dominate.
        compared: share of the pixels that are compared: valid in every draw, off the border.
        draws: how often noise was drawn.
    """

    predicted_um: float
    obtained_um: float
    scatter_um: float | None
    stated_um: float
    rms_um: float
    compared: float
    draws: int

    @property
    def ratio(self) -> float:
        """Predicted over obtained."""
        return self.predicted_um / self.obtained_um


@dataclass(frozen=True)
class Plan:
    """Candidates of an acquisition.

    Attributes:
        name: of the scene.
        timing: of the stage; the dwell time is the scene's.
        candidates: of every combination of views, pixel and dwell, in this order.
        wanted_um: wanted `height_std_um`, or None.
        reaching: where it is wanted: of every combination of views and pixel that reaches it within the dwell times,
            the candidate of just this error, its dwell interpolated (or the shortest dwell, if that reaches it), the
            fastest first.
        check: of the fastest one (or of the first candidate, if no error is wanted), or None.
    """

    name: str
    timing: Timing
    candidates: tuple[Candidate, ...]
    wanted_um: float | None = None
    reaching: tuple[Candidate, ...] = ()
    check: Check | None = None

    @property
    def chosen(self) -> Candidate:
        """The candidate that reaches the wanted error soonest; the first one where none is wanted or reaches it."""
        return self.reaching[0] if self.reaching else self.candidates[0]

    @property
    def curves(self) -> list[tuple[Candidate, ...]]:
        """The candidates of each combination of views and pixel, by dwell."""
        groups = itertools.groupby(self.candidates, lambda c: (c.rotations_deg, c.pixel_size_um))
        return [tuple(group) for _, group in groups]

    def as_dict(self) -> dict[str, Any]:
        """Make a JSON-compatible record."""
        found = {**asdict(self), "chosen": asdict(self.chosen)}
        if self.check:
            found["check"]["ratio"] = self.check.ratio
        return found


@checked
def plan(
    scene: SceneFile,
    *,
    dwell_s: Sequence[float] = (),
    pixel_size_um: Sequence[float] = (),
    rotations_deg: Sequence[Sequence[float]] = (),
    wanted_um: float | None = None,
    timing: Timing | None = None,
    draws: int = 0,
    n_samples: int = N_SAMPLES,
    say: Callable[[str], None] = lambda text: None,
) -> Plan:
    """Compute time, SNR and expected errors of the heights for candidates of dwell, pixel size and views.

    Valid for rasters at one distance, and for surfaces that the fit can express: the errors are those of counting
    noise and of the priors in [reconstruct] and [uncertainty], for the sample of the scene and the cosine law. Depth
    jumps are taken as known. Pixels that not all scans see (`seen_by_all` < 1) are left out of `height_std_um`.

    Args:
        scene: expected sample, instrument and scan. `scan.atoms_per_pixel` and `noise.background_per_pixel` belong to
            `noise.dwell_s` and are scaled with the dwell time.
        dwell_s: candidates [s]; default: the scene's; with `wanted_um`: a quarter of it to four times it.
        pixel_size_um: candidates on the same field [um]; default: the scene's.
        rotations_deg: candidates, each the rotations of its scans [deg]; default: the scene's.
        wanted_um: wanted standard deviation of typical heights [um].
        timing: times of the stage; default: move_s and flyback_s of table [noise].
        draws: simulate and reconstruct the chosen candidate so often.
        n_samples: of the posterior.
        say: called with a message for each combination of views and pixel.

    Raises:
        SceneError: no dwell time, no raster, several distances, rotations at oblique incidence or repeated ones, less
            than 3 images, a candidate that is not > 0.
        GuardError: no pixel of the simulation is valid.

    Example:
        >>> found = hx.plan(scene, pixel_size_um=(20.0, 30.0), wanted_um=2.0)
        >>> found.chosen.dwell_s, found.chosen.seconds

    Source: Cramer-Rao bound as in `hx.fisher`.
    """
    scan, base = scene.scan, stated_timing(scene).dwell
    if not isinstance(scan, Raster) or scan.sample_distances_um:
        raise SceneError(
            "scan: a plan needs a raster at one distance: set scan.kind = 'raster', no sample_distances_um"
        )
    for name, values in (
        ("dwell", dwell_s),
        ("pixel size", pixel_size_um),
        ("error", [] if wanted_um is None else [wanted_um]),
    ):
        if wrong := [v for v in values if not (math.isfinite(v) and v > 0.0)]:
            raise SceneError(f"every {name} of a plan must be > 0, got {wrong[0]:g}: correct it")
    timing = timing or stated_timing(scene)
    dwells = sorted(dwell_s) or ([0.25 * base, base, 4.0 * base] if wanted_um is not None else [base])
    views = [tuple(v) for v in rotations_deg] or [scan.rotations_deg or (0.0,)]
    pixels = list(pixel_size_um) or [scan.pixel_size_um]
    candidates = []
    for rotations, pixel in itertools.product(views, pixels):
        say(f"{len(rotations)} scans, pixels of {pixel:g} um")
        candidates += [_candidate(at(scene, rotations, pixel, d), scene, rotations, timing, n_samples) for d in dwells]
    found = Plan(scene.name, timing, tuple(candidates), wanted_um)
    if wanted_um is not None:
        reaching = filter(None, (_at_error(curve, wanted_um, timing, scene) for curve in found.curves))
        found = replace(found, reaching=tuple(sorted(reaching, key=lambda c: c.seconds)))
    if draws:
        c = found.chosen
        say(f"simulating the chosen candidate, {draws} draws of the noise")
        found = replace(found, check=check(at(scene, c.rotations_deg, c.pixel_size_um, c.dwell_s), draws, n_samples))
    return found


def stated_timing(scene: SceneFile) -> Timing:
    """Take the times of a stage from table [noise] of a scene.

    Raises:
        SceneError: it states no dwell time.
    """
    noise = scene.noise
    if noise.dwell_s is None:
        raise SceneError(
            "noise.dwell_s is needed for a plan, got none: give the counting time that scan.atoms_per_pixel belongs to"
        )
    return Timing(noise.dwell_s, 0.0, noise.move_s, noise.flyback_s)


def measured_timing(path: str | Path) -> Timing:
    """Take the times of a stage from a measured scan: pause as stated, time to move from its duration.

    Args:
        path: of one B-SHeM or A-SHeM scan (.mat, or .h5 of `helio import`); of several, the first counts.

    Raises:
        InputFileError: no such scan, or its file does not state its duration.
    """
    scan = read_acquisitions(path)[0]
    if scan.seconds is None:
        raise InputFileError(f"{path}: states no duration of the scan: give noise.move_s instead")
    return Timing(scan.dwell, scan.pause, measure_move(scan.seconds, scan.n_pixels, scan.dwell, scan.pause))


def at(scene: SceneFile, rotations_deg: Sequence[float], pixel_size_um: float, dwell_s: float) -> SceneFile:
    """Return a scene whose one scan holds the images of all scans of a candidate.

    Rotations of the sample become rotations of the detectors the other way, which is the same at normal incidence but
    for the field that all scans see. Counts scale with the dwell time.

    Raises:
        SceneError: oblique incidence, repeated rotations, less than 3 images, too many pixels.
    """
    scan, n = scene.scan, len(scene.detector)
    assert isinstance(scan, Raster) and scene.noise.dwell_s is not None  # checked by plan
    is_sample = scan.rotate == "sample"
    if is_sample and any(rotations_deg) and scene.beam.incidence_deg > 0.0:
        raise SceneError(
            f"rotations of the sample need normal incidence, got a beam at {scene.beam.incidence_deg:g} deg: set "
            "scan.rotate = 'detectors' or plan without rotations"
        )
    if len({round(a % 360.0, 6) for a in rotations_deg}) < len(rotations_deg):
        raise SceneError(
            f"the rotations of the scans must differ, got {list(rotations_deg)} deg: remove the repeated one"
        )
    if n * len(rotations_deg) < MIN_IMAGES:
        raise SceneError(
            f"heights need {MIN_IMAGES} images or more, got {len(rotations_deg)} scans of {n} detectors: add rotations"
        )
    turned = scan.model_copy(
        update={"rotations_deg": tuple(-a if is_sample else a for a in rotations_deg), "rotate": "detectors"}
    )
    images = [
        d.model_copy(update={"name": f"{d.name} {a:g}" if len(rotations_deg) > 1 else d.name})
        for view, a in zip(views_of(turned, scene.instrument), rotations_deg, strict=True)
        for d in view.instrument.detector
    ]
    share, noise = dwell_s / scene.noise.dwell_s, scene.noise
    per_image = {
        key: tuple(factor * v for _ in rotations_deg for v in noise.per_detector(key, n))
        for key, factor in (("background_per_pixel", share), ("gain", 1.0), ("lag_s", 1.0), ("drift_per_pixel", share))
    }
    zoom = scan.pixel_size_um / pixel_size_um
    size = {"nx": max(2, round(scan.nx * zoom)), "ny": max(2, round(scan.ny * zoom)), "pixel_size_um": pixel_size_um}
    atoms = {"atoms_per_pixel": share * scan.atoms_per_pixel, "rotations_deg": (), "rotate": "sample"}
    tables = {
        "detector": tuple(images),
        "scan": scan.changed(**size, **atoms),
        "noise": noise.changed(**per_image, dwell_s=dwell_s),
    }
    return scene.model_copy(update=tables)


@dataclass(frozen=True)
class Expected:
    """What `hx.fisher` expects of a scene: heights [y, x], samples of their errors [sample, y, x], um; SNR by image."""

    height: np.ndarray
    samples: np.ndarray
    snr: np.ndarray

    @property
    def level_std(self) -> float:
        """Standard deviation of the mean height of the upper half of the relief above the substrate [um]."""
        away = abs(self.height - np.median(self.height[border_mask(self.height.shape, 0.06)]))
        return float(np.sqrt(np.mean(np.mean(self.samples[:, away >= 0.5 * away.max()], axis=1) ** 2)))


def typical(deviations: np.ndarray) -> float:
    """Compute the standard deviation of typical heights: that of Gaussian errors of the same median size.

    A few heights beside walls, which no scan determines, do not count.
    """
    return 1.4826 * float(np.median(abs(deviations)))


def expect(scene: SceneFile, n_samples: int = N_SAMPLES) -> Expected:
    """Compute what an acquisition of one scan would determine of the true surface of its scene."""
    x, y = scene.positions()
    truth = true_surface(scene, x, y)
    optics, n = Optics.of(scene.instrument), len(scene.detector)
    assert truth.normals is not None  # of a scene
    surface = Surface(truth.height, *slopes_of_normal(truth.normals, np.asarray(optics.beam_shift))[:2])
    gain, background = (scene.noise.per_detector(key, n) for key in ("gain", "background_per_pixel"))
    dose = scene.scan.atoms_per_pixel * gain * substrate_albedo(scene)
    known = {"uncertainty": scene.uncertainty, "settings": scene.reconstruct, "n_samples": n_samples}
    found = fisher(surface, optics, BeamPositions(x, y), dose, background=background, **known)
    signal = dose * substrate_signal(optics)
    return Expected(truth.height, found.posterior.samples, signal / np.sqrt(signal + background))


def substrate_albedo(scene: SceneFile) -> float:
    """Return the share of the atoms that the sample's main material scatters."""
    terms = scene.read_laws().get(scene.sample.material_names[0])
    return 1.0 if terms is None else sum(term.share for term in terms)


def check(scene: SceneFile, draws: int, n_samples: int = N_SAMPLES) -> Check:
    """Simulate a scene of one scan, draw its noise `draws` times, reconstruct, and compare the errors with `expect`.

    Raises:
        GuardError: no pixel is valid in every draw.
    """
    expected, border = expect(scene, n_samples), border_mask(scene.image_shape, scene.reconstruct.border_fraction)
    clean = pipeline.simulate(scene).only()
    seeds = (scene.noise.model_copy(update={"seed": scene.noise.seed + i, "enabled": True}) for i in range(draws))
    noisy = (pipeline.record(scene.model_copy(update={"noise": n}), clean) for n in seeds)
    recs = []
    for stack in noisy:
        recs.append(pipeline.reconstruct(stack.only(), "refine", settings=scene.reconstruct))
        end_if_interrupted(recs[-1].status)
    use = np.logical_and.reduce([~border, *(r.is_valid for r in recs)])
    if not use.any():
        raise GuardError(f"no pixel is valid in all {draws} reconstructions of the check: see helio run on this scene")
    errors = np.array([r.height - expected.height for r in recs])[:, use]
    stated = np.concatenate([r.height_samples[:, use] for r in recs if r.height_samples is not None])
    return Check(
        predicted_um=typical(expected.samples[:, use]),
        obtained_um=typical(errors),
        scatter_um=typical(errors - errors.mean(0)) * math.sqrt(draws / (draws - 1)) if draws > 1 else None,
        stated_um=typical(stated),
        rms_um=float(np.sqrt(np.mean(errors**2))),
        compared=float(use.mean()),
        draws=draws,
    )


def _candidate(
    one: SceneFile, scene: SceneFile, rotations: tuple[float, ...], timing: Timing, n_samples: int
) -> Candidate:
    """Evaluate a candidate, given as one scan (`at`)."""
    scan, dwell = one.scan, one.noise.dwell_s
    assert isinstance(scan, Raster) and dwell is not None  # of `at`
    seen = (
        _seen_by_all(one, rotations, scene.scan.axis_um) if scene.scan.rotate == "sample" else _seen_by_all(one, (0.0,))
    )
    use = seen & ~border_mask(seen.shape, scene.reconstruct.border_fraction)
    if not use.any():
        raise SceneError(
            f"no pixel is seen by all scans rotated by {', '.join(f'{a:g}' for a in rotations)} deg about "
            f"{list(scene.scan.axis_um)} um: move scan.axis_um into the field"
        )
    expected, timing, n_images = expect(one, n_samples), timing.at_dwell(dwell), len(one.detector)
    seconds, alone = (_seconds(timing, scene, seen.shape, n) for n in (len(rotations), n_images))
    even = _seen_by_all(one, [360.0 * i / n_images for i in range(n_images)])
    per_height, per_height_alone = (
        seconds_per_height(s, seen.size, float(by.mean())) for s, by in ((seconds, seen), (alone, even))
    )
    return Candidate(
        rotations_deg=rotations,
        n_images=n_images,
        pixel_size_um=scan.pixel_size_um,
        shape=seen.shape,
        dwell_s=dwell,
        seconds=seconds,
        snr=float(expected.snr.min()),
        height_std_um=typical(expected.samples[:, use]),
        level_std_um=expected.level_std,
        seen_by_all=float(seen.mean()),
        speed_up=per_height_alone / per_height,
    )


def _seen_by_all(
    one: SceneFile, rotations_deg: Sequence[float], axis_um: tuple[float, float] | None = None
) -> np.ndarray:
    """Return True where all scans of a rotated sample see a pixel [y, x]; default axis: the middle of the field."""
    x, y = one.positions()
    angles = np.radians(rotations_deg)
    axis = axis_um or (0.5 * (x[0] + x[-1]), 0.5 * (y[0] + y[-1]))
    return scans_per_pixel(x, y, angles, shifts_about(axis, angles)) == len(angles)


def _seconds(timing: Timing, scene: SceneFile, shape: tuple[int, int], n_scans: int) -> float:
    """Compute the time of scans of rows and columns, in the order of the scene's fast axis [s]."""
    rows, columns = shape
    n_lines, n_per_line = (rows, columns) if scene.noise.fast_axis == "x" else (columns, rows)
    return timing.seconds(n_lines, n_per_line, n_scans)


def _at_error(curve: Sequence[Candidate], wanted_um: float, timing: Timing, scene: SceneFile) -> Candidate | None:
    """Interpolate between dwell times (logarithms) to a wanted error; None where none of them reaches it."""
    errors = np.minimum.accumulate([c.height_std_um for c in curve])
    if errors[-1] > wanted_um:
        return None
    if errors[0] <= wanted_um:
        return curve[0]

    def interpolated(name: str) -> float:
        return float(np.exp(np.interp(-np.log(wanted_um), -np.log(errors), np.log([getattr(c, name) for c in curve]))))

    values = {name: interpolated(name) for name in ("dwell_s", "snr", "level_std_um")}
    last, timing = curve[-1], timing.at_dwell(values["dwell_s"])
    seconds = _seconds(timing, scene, last.shape, len(last.rotations_deg))
    return replace(last, **values, height_std_um=wanted_um, seconds=seconds)
