"""Measurements of `helio measure`: facets, profile, steps, texture, ripple, cracks, vertical edges.

Each measurer returns a JSON-compatible record and lines of text; figures are drawn on request.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from helio_jax.arrays import as_json
from helio_jax.errors import SceneError
from helio_jax.figures.canvas import save_figure
from helio_jax.figures.cracks import crack_panel
from helio_jax.figures.overlay import facet_map
from helio_jax.figures.ripple import ripple_panel
from helio_jax.figures.trust import trust_lines
from helio_jax.measure.crack_text import crack_lines, wall_lines
from helio_jax.measure.cracks import find_cracks
from helio_jax.measure.facets import Facets, FacetSettings, find_facets
from helio_jax.measure.lines import LineSettings
from helio_jax.measure.profiles import measure_profile
from helio_jax.measure.regions import inside_polygon, parse_region
from helio_jax.measure.ripple import compare_with_images, height_ripple, image_spectra
from helio_jax.measure.spectrum import RippleSettings
from helio_jax.measure.step_height import StepHeight, measure_step, measure_step_height
from helio_jax.measure.texture import Texture, TextureSettings, measure_texture
from helio_jax.measure.texture_parameters import PARAMETERS
from helio_jax.measure.walls import WallSettings, find_walls
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction


class Wanted(NamedTuple):
    """Requested measurements; `regions` (see `regions`) and `settings` apply to them.

    `profile`: x0, y0, x1, y1 in the sample frame [um]. `edges`: of the ridge or groove, along it [um]. `table`: a row
    for every point of the profile, or for every crack and vertical edge, will be written.
    """

    facets: bool = False
    profile: tuple[float, float, float, float] | None = None
    step: bool = False
    texture: bool = False
    ripple: bool = False
    regions: tuple[str, ...] = ()
    cracks: bool = False
    vertical_edges: bool = False
    table: bool = False
    step_height: bool = False
    edges: tuple[float, float] | None = None
    settings: Mapping[str, Any] = {}

    @property
    def lines(self) -> bool:
        """Whether cracks or vertical edges are requested."""
        return self.cracks or self.vertical_edges


@dataclass
class _Job:
    """Input of the measurers, and their results: record, lines of text."""

    rec: Reconstruction
    wanted: Wanted
    regions: list[np.ndarray]
    settings: dict[str, Any]
    figure: str | Path | None
    stack: MicrographStack | None
    found: dict[str, Any] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)


_SETTINGS = {
    "facets": FacetSettings,
    "ripple": RippleSettings,
    "cracks": LineSettings,
    "vertical_edges": WallSettings,
    "texture": TextureSettings,
}
"""Settings of each measurement, by its field of `Wanted`."""


def _settings(wanted: Wanted) -> dict[str, Any]:
    """Return the settings of each requested measurement, with the entries of `wanted.settings` that belong to it."""
    has = {name: kind.model_fields.keys() for name, kind in _SETTINGS.items() if getattr(wanted, name)}
    known = sorted(set().union(*has.values()))
    for key in wanted.settings:
        if key not in known:
            raise SceneError(
                f"--set {key}: the requested measurements have no such setting, only: {', '.join(known) or 'none'}"
            )
    chosen = {name: {k: v for k, v in wanted.settings.items() if k in has.get(name, ())} for name in _SETTINGS}
    return {name: kind().changed(**chosen[name]) for name, kind in _SETTINGS.items()}


def _check(wanted: Wanted, has_figure: bool, has_stack: bool) -> None:
    """Check that the options go together.

    Raises:
        SceneError: they do not.
    """
    w = wanted
    refused = (
        (
            not (w.facets or w.profile or w.texture or w.ripple or w.lines),
            "measure needs one or more of --facets, --profile X0 Y0 X1 Y1, --texture, --ripple, --cracks, "
            "--vertical-edges",
        ),
        (
            (w.step or w.step_height) and not w.profile,
            "--step and --step-height need --profile X0 Y0 X1 Y1 across the step",
        ),
        (w.edges and not w.step_height, "--step-edges are those of --step-height: add it"),
        (
            has_figure and w.facets + w.ripple + w.lines != 1,
            "--figure draws the facets, the ripple, or cracks and vertical edges: add --facets, --ripple, or --cracks "
            "and/or --vertical-edges, and none of the others",
        ),
        (
            w.regions and not (w.ripple or w.texture or w.lines),
            "--region limits --ripple, --texture, --cracks and --vertical-edges: add one of them",
        ),
        (has_stack and not (w.ripple or w.cracks), "--stack is used by --ripple and --cracks: add one of them"),
        (w.cracks and not has_stack, "--cracks needs the micrographs: add --stack FILE.h5, from helio calibrate"),
        (
            w.table and bool(w.profile) + w.lines != 1,
            "--table has a row for every point of a profile, or for every crack and vertical edge: add --profile, or "
            "--cracks and/or --vertical-edges, not both",
        ),
    )
    for is_wrong, message in refused:
        if is_wrong:
            raise SceneError(message)


def measure_height_map(
    rec: Reconstruction, wanted: Wanted, figure: str | Path | None = None, stack: MicrographStack | None = None
) -> tuple[dict[str, Any], list[str]]:
    """Make the requested measurements; return a JSON-compatible record and lines to print.

    Args:
        rec: heights.
        wanted: requested measurements.
        figure: file for the figure of the facets, of the ripple, or of cracks and vertical edges.
        stack: calibrated micrographs of these heights, for the test of the ripple and for cracks.

    Raises:
        SceneError: options that do not go together, or an unknown setting.
        GuardError: too few heights are known.
    """
    _check(wanted, figure is not None, stack is not None)
    how = _settings(wanted)
    regions = [inside_polygon(parse_region(text), rec.raster_x, rec.raster_y) for text in wanted.regions]
    job = _Job(rec, wanted, regions or [np.ones(rec.height.shape, bool)], how, figure, stack)
    job.found["trust"], job.found["reconstructed"] = rec.trust, reconstructed_area(rec)
    job.lines += trust_lines(rec.trust)
    if rec.height_std is not None:
        area = job.found["reconstructed"]
        job.lines.append(f"valid and known to {area['max_std_um']:g} um (s.d.): {area['share']:.1%} of the pixels")
    for is_wanted, measure in (
        (wanted.facets, _measure_facets),
        (wanted.profile, _measure_profile),
        (wanted.texture, _measure_texture),
        (wanted.ripple, _measure_ripple),
        (wanted.lines, _measure_lines),
    ):
        if is_wanted:
            measure(job)
    return as_json(job.found), job.lines


def _measure_facets(job: _Job) -> None:
    facets = find_facets(job.rec, job.settings["facets"])
    job.found["facets"] = facets.as_dict()
    job.lines += _facet_lines(facets)
    if job.figure:
        save_figure(facet_map(job.rec, facets.labels), job.figure)


def _measure_profile(job: _Job) -> None:
    """Read a profile and, if requested, its step heights, which take the place of its points in the printed lines."""
    wanted = job.wanted
    assert wanted.profile is not None  # the caller checks
    line = measure_profile(job.rec, wanted.profile[:2], wanted.profile[2:])
    job.found["profile"] = line.as_dict()
    if wanted.step:
        step = measure_step(line)
        job.found["step"] = vars(step)
        job.lines += _step_lines("step", step)
    if wanted.step_height:
        step = measure_step_height(line, wanted.edges)
        job.found["step_height"] = vars(step)
        job.lines += _step_lines("step height (ISO 5436-1 type A)", step)
    if not (wanted.step or wanted.step_height):
        job.lines += line.lines()


def _step_lines(what: str, step: StepHeight) -> list[str]:
    """Format a step height, and what it is made of."""
    edges = " and ".join(f"{e:.1f}" for e in step.edges)
    parts = ", ".join(f"{low:.0f} to {high:.0f}" for low, high in step.parts)
    return [
        f"{what}: {step.height:.3f} +- {step.std:.3f} um at {edges} um",
        f"  lines of slope {step.slope:+.4f} over {parts} um; rms about them {step.rms:.3f} um",
        f"  s.d. from: {step.errors}",
    ]


def _measure_texture(job: _Job) -> None:
    texture = measure_texture(job.rec, job.settings["texture"], region=np.any(job.regions, axis=0))
    job.found["texture"] = texture.as_dict()
    job.lines += _texture_lines(texture)


def _texture_lines(texture: Texture) -> list[str]:
    """Format the scale-limited surface and a table of the parameters."""
    how = texture.settings
    filters = [
        f"{name} {nesting:g} um" if nesting else f"no {name}"
        for name, nesting in (("S-filter", how.s_filter_um), ("L-filter", how.l_filter_um))
    ]
    bias = "subtracted" if how.subtract_noise else "not subtracted"
    lines = [
        f"texture (ISO 25178-2) of the {texture.surface}: {', '.join(filters)}, form removed: {how.form}",
        f"  {texture.n_pixels} valid heights, {texture.share:.1%} of their field; {texture.grid}",
        f"  s.d. from: {texture.errors}",
        f"  noise bias, if these errors are noise in the heights: {bias}",
        f"  {'':<6}{'value':>12}{'s.d.':>12}{'noise bias':>12}",
    ]
    for name, p in texture.parameters.items():
        numbers = "".join(f"{v:>12.5g}" if np.isfinite(v) else f"{'-':>12}" for v in (p.value, p.std, p.noise_bias))
        lines.append(f"  {name:<6}{numbers} {p.unit:<3} {PARAMETERS[name].meaning}")
    if np.isfinite(texture.Sal) and not np.isfinite(texture.Str):
        lines.append("  Str: the autocorrelation does not fall to 0.2 within half the field in some direction")
    return lines


def _measure_ripple(job: _Job) -> None:
    """Measure the strongest ripple, and test it on the micrographs."""
    how, stack = job.settings["ripple"], job.stack
    r, spectrum, along = height_ripple(job.rec, job.regions, how)
    excluded = "" if how.along_axes else ", which are excluded because of scan lines"
    job.lines += [
        f"ripple: wavelength {r.wavelength_um:.1f} +- {r.wavelength_std_um:.1f} um, amplitude {r.amplitude:.3f} +- "
        f"{r.amplitude_std:.3f} um, wave vector at {r.direction_deg:+.1f} +- {r.direction_std_deg:.1f} deg from x",
        f"  peak {r.peak_over_floor:.1f} x noise floor, mean of {r.averages} spectra; false-alarm probability in the "
        f"searched range {r.false_alarm:.1e}",
        f"  {r.axis_angle_deg:.0f} deg from the raster's axes{excluded}",
    ]
    record = vars(r) | {"unit": "um"}
    spectra = {"heights": spectrum}
    if stack is not None:
        check = compare_with_images(stack, r, job.regions, how)
        record["micrographs"] = vars(check) | {"verdict": check.verdict}
        for name, share in check.shares.items():
            std, expected = check.shares_std[name], check.expected[name]
            job.lines.append(f"  {name}: {share:.2%} +- {std:.2%} of the signal, surface wave: {expected:.2%}")
        job.lines.append(
            f"  {check.verdict} (amplitude {check.amplitude_um:.3f} um; false alarm {check.false_alarm:.1e}, misfit "
            f"{check.misfit:.1e})"
        )
    job.found["ripple"] = record
    if job.figure:
        spectra |= image_spectra(stack, job.regions, how) if stack is not None else {}
        save_figure(ripple_panel(job.rec, along, job.regions, r, spectra), job.figure)


def _measure_lines(job: _Job) -> None:
    """Find cracks and vertical edges."""
    wanted, inside = job.wanted, np.any(job.regions, axis=0)
    cracks = walls = None
    if wanted.cracks and job.stack is not None:
        cracks = find_cracks(job.rec, job.stack, inside, job.settings["cracks"])
        job.found["cracks"] = cracks.as_dict()
        job.lines += crack_lines(cracks)
        if not wanted.regions:
            job.lines.append(
                "  the whole raster was searched, including feet of steps and debris: --region selects one face"
            )
    if wanted.vertical_edges:
        walls = find_walls(job.rec, inside, job.settings["vertical_edges"])
        job.found["vertical_edges"] = walls.as_dict()
        job.lines += wall_lines(walls)
    if job.figure:
        save_figure(crack_panel(job.rec, inside, job.stack, cracks, walls), job.figure)


def reconstructed_area(rec: Reconstruction, max_std_um: float = 20.0) -> dict[str, Any]:
    """Compute the fraction of the raster that is valid and whose height is known to `max_std_um` if stated.

    With a free border the errors are taken relative to their median, because the common level is not determined.
    """
    good = rec.is_valid & np.isfinite(rec.height)
    std = rec.height_std
    if rec.height_samples is not None and good.any() and rec.border == "free":
        level = np.median(rec.height_samples[:, good], axis=1)
        std = np.sqrt(np.mean((rec.height_samples - level[:, None, None]) ** 2, axis=0))
    known = good if std is None else good & (std <= max_std_um)
    return {
        "share": float(known.mean()),
        "valid_share": float(good.mean()),
        "is_contradicted": rec.is_contradicted,
        "max_std_um": max_std_um if rec.height_std is not None else None,
    }


def _facet_lines(facets: Facets) -> list[str]:
    """Format a table of facets and one of edges."""
    lines = ["facet  tilt  azimuth  area (mm2)         long (um)   short (um)  projected  rms (um)"]
    for f in facets.facets:
        lines.append(
            f"{f.number:>5} {f.tilt_deg:5.1f} {f.azimuth_deg:8.1f}  "
            f"{f.area_um2 / 1e6:.4f} +- {f.area_std_um2 / 1e6:.4f}  "
            f"{f.long_um:6.0f} +- {f.long_std_um:<3.0f} {f.short_um:5.0f} +- {f.short_std_um:<3.0f} "
            f"{f.projected_long_um:.0f} x {f.projected_short_um:.0f}  {f.rms_um:.1f}"
            f"{'  cut by the border' if f.is_cut else ''}"
        )
    lines.append("edge    angle of planes (deg)  of profiles (deg)  length (um)")
    for e in facets.edges:
        lines.append(
            f"{e.facets[0]}-{e.facets[1]:<5} {e.angle_deg:7.2f} +- {e.angle_std_deg:<8.2f} "
            f"{e.profile_angle_deg:7.2f} +- {e.profile_std_deg:.2f} ({e.n_profiles})  {e.length_um:.0f}"
        )
    return lines
