"""Simulation versus experiment: a scene simulated in the instrument that measured, compared with the measurement.

Measured stack and scene file -> the scene's micrographs on the stack's raster, the sample moved to its place in the
data, fitted to the data by gain, offset and slow drift (scores/agreement), residuals in standard errors, contrast by
cause, a verdict. `explain` adds one effect at a time and states its change of chi-square, of the evidence, and of the
height that the near-field method finds with the effect subtracted.
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from helio_jax.arrays import pitch
from helio_jax.errors import HelioError, InputFileError, SceneError
from helio_jax.figures.agreement import save_agreement, save_effects
from helio_jax.formats.safe import atomic_path, make_folder
from helio_jax.forward.form_factor import form_factor
from helio_jax.forward.optics import Optics
from helio_jax.forward.render import single_scattering
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.scores.agreement import REACH, Agreement, Terms, contrast_by_cause, find_shift, normalise
from helio_jax.workflows import pipeline
from helio_jax.workflows.effects import EFFECTS, LAG, Images
from helio_jax.workflows.scene_file import SceneFile, load_scene
from helio_jax.workflows.truth import true_surface

TOP = 0.99
"""Quantile of the scene's heights above which pixels are its top."""
MAX_ITERATIONS, CONVERGED = 5, 0.05
"""The sample is moved and simulated again until it moves by less than this [pixels]."""
WRITTEN = ("comparison.json", "comparison.png", "effects.png")
"""Files that a comparison writes in its folder; the last one where effects were explained."""
MAX_LAG = 5.0
"""Longest response time of a detector that `explain` tries [pixels]."""
Progress = Callable[[str], Any]
"""Called with the name of the next step."""


@dataclass(frozen=True)
class Row:
    """Result of one effect.

    Attributes:
        name: of the effect.
        chi2: per pixel, over all pixels.
        d_chi2: change of the total chi-square against the usual model.
        d_bic: change of the Bayesian information criterion; below -10: strong evidence for the effect.
        height: found by `nearfield` with the effect subtracted from the data [um].
        note: reason why there are no numbers.
    """

    name: str
    chi2: float = np.nan
    d_chi2: float = np.nan
    d_bic: float = np.nan
    height: float = np.nan
    note: str = ""


@dataclass(frozen=True)
class Comparison:
    """A simulation against a measurement.

    Attributes:
        stack: the measurement.
        images: the simulation, sample moved.
        agreement: of both.
        contrast: by cause, as a fraction of the substrate's signal [detector].
        height: found by `nearfield` from the data, normalised by the simulation [um].
        effects: one row each, with `explain`.
    """

    stack: MicrographStack
    images: Images
    agreement: Agreement
    contrast: Mapping[str, np.ndarray]
    height: float
    effects: tuple[Row, ...] = field(default=())

    def as_dict(self) -> dict[str, Any]:
        """Make a JSON-compatible summary."""
        known = [{k: v for k, v in vars(row).items() if v == v and v != ""} for row in self.effects]
        contrast = {name: [float(v) for v in values] for name, values in self.contrast.items()}
        summary = self.agreement.as_dict() | {"contrast": contrast, "nearfield_height_um": self.height}
        return summary | ({"effects": known} if known else {})

    def as_table(self) -> list[tuple[str, str, str]]:
        """List label, value and unit of the main results."""
        a, out = self.agreement, []
        out += [("sample found at x, y", f"{a.shift[0]:.1f}, {a.shift[1]:.1f}", "um from where the scene has it")]
        out += [("height by nearfield, data normalised so", f"{self.height:.1f}", "um")]
        for k, name in enumerate(a.detectors):
            text = f"{a.chi2[k]:.2f} ({a.chi2_unflagged[k]:.2f} unflagged)"
            out.append((f"{name}: chi-square per pixel", text, f"gain {a.gain[k]:.4g}, offset {a.offset[k]:.5g}"))
        for row in self.effects:
            if row.note:
                out.append((row.name, "-", row.note))
                continue
            text = f"chi2/pixel {row.chi2:.2f}, BIC {row.d_bic:+.0f}"
            out.append((row.name, text, f"height {row.height:.1f} um ({row.height - self.height:+.1f})"))
        return out

    def write(self, folder: Path) -> list[Path]:
        """Write comparison.json, comparison.png and, with effects, effects.png; return their paths."""
        make_folder(folder)
        out = [folder / name for name in (WRITTEN if self.effects else WRITTEN[:2])]
        with atomic_path(out[0]) as part:
            part.write_text(json.dumps(self.as_dict(), indent=1) + "\n", encoding="utf-8")
        save_agreement(self.stack, self.agreement, self.contrast, out[1])
        if self.effects:
            save_effects([(row.name, row.d_bic, row.height) for row in self.effects], self.height, out[2])
        return out


def raster_of(stack: MicrographStack, scene: SceneFile, shift: tuple[float, float]) -> dict[str, Any]:
    """Compute the settings that give the scene the raster of the stack, the sample moved by `shift` [um]."""
    steps = pitch(stack.x), pitch(stack.y)
    stretch = 1.0 / math.cos(math.radians(scene.beam.incidence_deg))
    along = 0 if scene.beam.azimuth_deg % 180.0 == 0.0 else 1
    across = steps[1 - along]
    for how, factor in (("sample", 1.0), ("beam", stretch)):
        if abs(steps[along] - factor * across) < 1e-6 * across:
            middle = float(stack.x.mean()) - shift[0], float(stack.y.mean()) - shift[1]
            values = {"nx": stack.x.size, "ny": stack.y.size, "pixel_size_um": across, "pitch": how}
            return {f"scan.{key}": value for key, value in (values | {"center_um": list(middle)}).items()}
    raise SceneError(
        f"{stack.name}: its raster has steps of {steps[0]:g} um in x and {steps[1]:g} um in y; a scene's are equal on "
        "the sample or across the beam: compare a scan with such a raster"
    )


def _images(path: Path, changes: Mapping[str, Any]) -> Images:
    """Simulate a scene with some settings changed."""
    scene = load_scene(path, dict(changes))
    found = pipeline.simulate(scene, maps=False).only(SceneError)
    assert found.by_order is not None and found.variance is not None and found.n_rays is not None  # simulated
    single, multiple = found.by_order[0] / found.n_rays, found.by_order[1:].sum(0) / found.n_rays
    truth = true_surface(scene, found.x, found.y)
    assert truth.normals is not None  # of a scene
    phi = form_factor(Optics.of(found.instrument), truth.height)
    unmasked = np.maximum(single_scattering(phi, np.moveaxis(truth.normals, -1, 0)), 0.0)
    return Images(found.instrument, single, multiple, unmasked, found.variance / found.n_rays**2, truth.height)


def _height(stack: MicrographStack, fit: Agreement, images: Images, lacking: np.ndarray, scene: SceneFile) -> float:
    """Compute the height of the scene's top by `nearfield` from the normalised data, an effect subtracted [um].

    The median over the highest (or deepest) hundredth of the scene's pixels, above the median of all.
    """
    gain = fit.gain[:, None, None]
    signal = (stack.counts - fit.model) / gain + images.total - lacking
    variance = None if stack.variance is None else stack.variance / gain**2
    clean = stack.replace(
        counts=signal, variance=variance, background=None, n_rays=1.0, unit="detected per beam atom",
        instrument=images.instrument,
    )  # fmt: skip
    rec = pipeline.reconstruct(clean, "nearfield", settings=scene.reconstruct, samples=0)
    away = np.abs(images.height - np.median(images.height))
    return float(np.median(rec.height[away >= np.quantile(away, TOP)]) - np.median(rec.height))


def compare(
    stack: MicrographStack | MicrographSet,
    scene_path: str | Path,
    *,
    overrides: Mapping[str, Any] | None = None,
    explain: bool = False,
    progress: Progress = lambda text: None,
) -> Comparison:
    """Simulate a scene in the instrument that measured, and compare it with the measurement.

    Args:
        stack: measured micrographs, one scan, with their variance.
        scene_path: the sample (a shape, a CAD mesh, a reconstruction) in its instrument; the raster is the stack's.
        overrides: settings that replace those of the scene, dotted keys.
        explain: add one effect at a time and tabulate its changes.
        progress: called with the name of the next step.

    Raises:
        SceneError: another number of detectors, several views, or a raster that a scene cannot have.
        InputFileError: several scans, a list of positions, or no micrographs at all.
        GuardError: a detector does not show the simulated contrast.
    """
    if not isinstance(stack, (MicrographStack, MicrographSet)):
        raise InputFileError(f"a scene is compared with micrographs, got {type(stack).__name__}: name a scan's file")
    data, path = stack.only(), Path(scene_path)
    if data.positions is not None:
        raise InputFileError(
            f"{data.name}: comparing needs a raster, this scan is a list of {len(data.positions)} positions"
        )
    given = dict(overrides or {})
    scene = load_scene(path, given)
    if scene.scan.n_views > 1:
        raise SceneError(
            f"{path}: scan has {scene.scan.n_views} views, comparing needs one: remove scan.rotations_deg and "
            "scan.sample_distances_um"
        )
    if scene.detector_names != data.instrument.detector_names:
        raise SceneError(
            f"{path}: its detectors {list(scene.detector_names)} are not those of the measured stack, "
            f"{list(data.instrument.detector_names)}: import the scan with this scene as its --instrument"
        )
    progress("simulating the scene, looking for the sample")
    shift, reach = (0.0, 0.0), REACH
    for last in (False,) * (MAX_ITERATIONS - 1) + (True,):  # moved by interpolation first, then simulated there
        here = given | raster_of(data, scene, shift)
        images = _images(path, here)
        found = find_shift(data, images.total, reach=reach)
        if last or np.hypot(*found) < CONVERGED * pitch(data.x):
            break
        shift, reach = (shift[0] + found[0], shift[1] + found[1]), 0.0
    agreement = normalise(data, images.total, own_variance=images.variance, shift=shift)
    contrast = contrast_by_cause(images.unmasked, images.single, images.multiple)
    height = _height(data, agreement, images, 0.0 * images.total, scene)
    out = Comparison(data, images, agreement, contrast, height)
    return replace(out, effects=_explained(out, path, here, progress)) if explain else out


def _explained(usual: Comparison, path: Path, here: Mapping[str, Any], progress: Progress) -> tuple[Row, ...]:
    """Compute the rows of the effects."""
    scene, data = load_scene(path, dict(here)), usual.stack
    rows = [_row("the usual model: offset, drift, slope", usual, usual.agreement, usual.height)]
    for effect in EFFECTS:
        progress(effect.name)
        changes = effect.changes(scene)
        if changes is None:
            rows.append(Row(effect.name, note="does not apply to this scene"))
            continue
        try:
            images = _images(path, {**here, **changes}) if changes else usual.images
            total = effect.total(images)
            terms = replace(effect.terms, lag=_best_lag(data, total)) if effect.name.startswith(LAG) else effect.terms
            fit = normalise(data, total, terms, own_variance=images.variance)
            lacking = 0.0 * total if effect.is_geometry else total - usual.images.total
            height = _height(data, fit, replace(images, single=total, multiple=0.0 * total), lacking, scene)
        except HelioError as e:
            rows.append(Row(effect.name, note=str(e)))
            continue
        label = f"{effect.name}: {terms.lag:.2f} pixels" if terms.lag else effect.name
        if fit.gain_drift.size:
            label += f": {' '.join(f'{drift:+.0%}' for drift in fit.gain_drift[:, 0])} to the end"
        rows.append(_row(label, usual, fit, height))
    return tuple(rows)


def _row(name: str, usual: Comparison, fit: Agreement, height: float) -> Row:
    total, before = (float(np.nansum(a.residuals**2)) for a in (fit, usual.agreement))
    return Row(name, float(np.mean(fit.chi2)), total - before, fit.bic - usual.agreement.bic, height)


def _best_lag(data: MicrographStack, probability: np.ndarray) -> float:
    """Find the response time that explains the data best [pixels]."""

    def misfit(lag: float) -> float:
        return float(np.nansum(normalise(data, probability, Terms(lag=lag)).residuals ** 2))

    return float(minimize_scalar(misfit, bounds=(0.0, MAX_LAG), method="bounded", options={"xatol": 0.02}).x)
