"""What `helio measure` answers: facets, profile, step, roughness, ripple, cracks, edges, as JSON and lines of text."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from helio_jax.arrays import as_json
from helio_jax.errors import SceneError
from helio_jax.figures.canvas import save_figure
from helio_jax.figures.cracks import crack_panel
from helio_jax.figures.overlay import facet_map
from helio_jax.figures.ripple import ripple_panel
from helio_jax.measure.crack_text import crack_lines, wall_lines
from helio_jax.measure.cracks import CrackSettings, find_cracks
from helio_jax.measure.facets import Facets, FacetSettings, find_facets
from helio_jax.measure.regions import inside_polygon, parse_region
from helio_jax.measure.ripple import (
    compare_with_images,
    height_ripple,
    image_spectra,
)
from helio_jax.measure.roughness import measure_profile, measure_roughness, measure_step
from helio_jax.measure.spectrum import RippleSettings
from helio_jax.measure.walls import WallSettings, find_walls
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction


class Wanted(NamedTuple):
    """What to measure; `profile` is x0, y0, x1, y1 [um]; `regions` (see `regions`): where; `settings`: how."""

    facets: bool = False
    profile: tuple[float, float, float, float] | None = None
    step: bool = False
    roughness: bool = False
    ripple: bool = False
    regions: tuple[str, ...] = ()
    cracks: bool = False
    vertical_edges: bool = False
    table: bool = False
    settings: Mapping[str, Any] = {}


_SETTINGS = {"facets": FacetSettings, "ripple": RippleSettings, "cracks": CrackSettings, "vertical_edges": WallSettings}
"""Settings of each measurement, by its field of `Wanted`."""


def _settings(wanted: Wanted) -> dict[str, Any]:
    """Return the settings of each measurement: those of `wanted.settings` that it has."""
    has = {name: kind.model_fields.keys() for name, kind in _SETTINGS.items() if getattr(wanted, name)}
    known = sorted(set().union(*has.values()))
    for key in wanted.settings:
        if key not in known:
            raise SceneError(f"--set {key}: what is measured has no such setting, only: {', '.join(known) or 'none'}")
    chosen = {name: {k: v for k, v in wanted.settings.items() if k in has.get(name, ())} for name in _SETTINGS}
    return {name: kind().changed(**chosen[name]) for name, kind in _SETTINGS.items()}


def measure_height_map(
    rec: Reconstruction, wanted: Wanted, figure: str | Path | None = None, stack: MicrographStack | None = None
) -> tuple[dict[str, Any], list[str]]:
    """Measure what is wanted; return a JSON-compatible record and lines to print.

    Args:
        rec: heights.
        wanted: what to measure.
        figure: picture of the facets, of the ripple, or of cracks and vertical edges.
        stack: calibrated micrographs of these heights: to ask about the ripple, to find cracks in.

    Raises:
        SceneError: nothing is wanted, a step or a figure without what it needs, or a setting that nothing wanted has.
        GuardError: too little is known there.
    """
    lines_wanted = wanted.cracks or wanted.vertical_edges
    if not (wanted.facets or wanted.profile or wanted.roughness or wanted.ripple or lines_wanted):
        raise SceneError(
            "measure needs one or more of --facets, --profile X0 Y0 X1 Y1, --roughness, --ripple, --cracks, "
            "--vertical-edges"
        )
    if wanted.step and not wanted.profile:
        raise SceneError("--step needs --profile X0 Y0 X1 Y1 across the step")
    if figure and wanted.facets + wanted.ripple + lines_wanted != 1:
        raise SceneError(
            "--figure draws the facets, the ripple, or cracks and vertical edges: give --facets, --ripple, or --cracks "
            "and/or --vertical-edges with it, and none of the others"
        )
    if wanted.regions and not (wanted.ripple or wanted.roughness or lines_wanted):
        raise SceneError(
            "--region says where --ripple, --roughness, --cracks and --vertical-edges measure: give one of them, too"
        )
    if stack is not None and not (wanted.ripple or wanted.cracks):
        raise SceneError("--stack is asked about the ripple, and for cracks: give --ripple or --cracks, too")
    if stack is None and wanted.cracks:
        raise SceneError("--cracks are found in the micrographs: give --stack FILE.h5, which helio calibrate wrote")
    if wanted.table and not lines_wanted:
        raise SceneError("--table has a row for every crack and vertical edge: give --cracks or --vertical-edges, too")
    how = _settings(wanted)
    regions = [inside_polygon(parse_region(text), rec.raster_x, rec.raster_y) for text in wanted.regions]
    where = regions or [np.ones(rec.height.shape, bool)]
    found: dict[str, Any] = {"reconstructed": reconstructed_area(rec)}
    lines = [f"reconstructed: {found['reconstructed']['share']:.1%} of the raster"]
    if wanted.facets:
        facets = find_facets(rec, how["facets"])
        found["facets"] = facets.as_dict()
        lines += _facet_lines(facets)
        if figure:
            save_figure(facet_map(rec, facets.labels), figure)
    if wanted.profile:
        line = measure_profile(rec, wanted.profile[:2], wanted.profile[2:])
        found["profile"] = {
            "distance_um": line.distance,
            "height_um": line.height,
            "height_std_um": line.height_std,
        }
        if wanted.step:
            step = measure_step(line)
            found["step"] = vars(step)
            lines.append(f"step: {step.height:.2f} +- {step.height_std:.2f} um at {step.position:.0f} um")
        else:
            lines += [f"{d:10.2f} {h:10.3f}" for d, h in zip(line.distance, line.height, strict=True)]
    if wanted.roughness:
        numbers = vars(measure_roughness(rec, np.any(regions, axis=0) if regions else None))
        found["roughness"] = numbers
        units = {"Sa": "um", "Sq": "um", "Sz": "um", "Sdr": "%"}
        lines += [f"{name:<9} {value:12.5g} {units.get(name, '')}".rstrip() for name, value in numbers.items()]
    if wanted.ripple:
        found["ripple"], more = _ripple(rec, where, figure, stack, how["ripple"])
        lines += more
    if lines_wanted:
        cracks = find_cracks(rec, stack, where, how["cracks"]) if wanted.cracks and stack is not None else None
        walls = find_walls(rec, np.any(where, axis=0), how["vertical_edges"]) if wanted.vertical_edges else None
        if cracks is not None:
            found["cracks"] = cracks.as_dict()
            lines += crack_lines(cracks)
            if not regions:
                lines.append("  all of the raster was searched, feet of steps and debris too: --region takes one face")
        if walls is not None:
            found["vertical_edges"] = walls.as_dict()
            lines += wall_lines(walls)
        if figure:
            save_figure(crack_panel(rec, np.any(where, axis=0), stack, cracks, walls), figure)
    return as_json(found), lines


def _ripple(
    rec: Reconstruction,
    regions: list[np.ndarray],
    figure: str | Path | None,
    stack: MicrographStack | None,
    settings: RippleSettings,
) -> tuple[dict[str, Any], list[str]]:
    """Measure the strongest ripple; return a record and lines."""
    r, spectrum, along = height_ripple(rec, regions, settings)
    lines = [
        f"ripple: wavelength {r.wavelength_um:.1f} +- {r.wavelength_std_um:.1f} um, amplitude {r.amplitude:.3f} +- "
        f"{r.amplitude_std:.3f} um, wave vector at {r.direction_deg:+.1f} +- {r.direction_std_deg:.1f} deg from x",
        f"  peak {r.peak_over_floor:.1f} x floor, mean of {r.averages} spectra; noise alone anywhere in the range: "
        f"{r.false_alarm:.1e}",
        f"  {r.axis_angle_deg:.0f} deg from the raster's axes, where nothing was looked for: scan lines are there",
    ]
    record = r.as_dict()
    if stack is not None:
        a = compare_with_images(stack, r, regions, settings)
        record["micrographs"] = vars(a) | {"verdict": a.verdict}
        for name, share in a.shares.items():
            lines.append(
                f"  {name}: {share:.2%} +- {a.shares_std[name]:.2%} of the signal, a wave of the surface: "
                f"{a.expected[name]:.2%}"
            )
        lines.append(f"  {a.verdict} ({a.amplitude_um:.3f} um high; noise {a.false_alarm:.1e}, misfit {a.misfit:.1e})")
    if figure:
        images = image_spectra(stack, regions, settings) if stack is not None else {}
        save_figure(ripple_panel(rec, along, regions, r, {"heights": spectrum, **images}), figure)
    return record, lines


def reconstructed_area(rec: Reconstruction, max_std_um: float = 20.0) -> dict[str, Any]:
    """Return the share of the raster that is reconstructed: valid, and its height known to `max_std_um` if stated.

    With a free border heights count from their median, for their common level means nothing there.
    """
    good = rec.is_valid & np.isfinite(rec.height)
    std = rec.height_std
    if rec.height_samples is not None and good.any() and rec.provenance.get("reconstruct", {}).get("border") == "free":
        level = np.median(rec.height_samples[:, good], axis=1)
        std = np.sqrt(np.mean((rec.height_samples - level[:, None, None]) ** 2, axis=0))
    sure = good if std is None else good & (std <= max_std_um)
    return {
        "share": float(sure.mean()),
        "valid_share": float(good.mean()),
        "max_std_um": max_std_um if rec.height_std is not None else None,
    }


def _facet_lines(facets: Facets) -> list[str]:
    """Return a table of facets and one of edges."""
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
