"""What `helio measure` answers: facets, a profile, a step, roughness, as JSON and as lines of text."""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from helio_jax.errors import SceneError
from helio_jax.evaluate.facets import Facets, FacetSettings, find_facets
from helio_jax.evaluate.figures import save_figure
from helio_jax.evaluate.overlay import facet_map
from helio_jax.evaluate.roughness import measure_profile, measure_roughness, measure_step
from helio_jax.reconstruction import Reconstruction


class Wanted(NamedTuple):
    """What to measure; `profile` is x0, y0, x1, y1 [um]."""

    facets: bool = False
    profile: tuple[float, float, float, float] | None = None
    step: bool = False
    roughness: bool = False
    min_pixels: int = 60


def measure_height_map(
    rec: Reconstruction, wanted: Wanted, figure: str | Path | None = None
) -> tuple[dict[str, Any], list[str]]:
    """Measure what is wanted; return a JSON-compatible record and lines to print.

    Raises:
        SceneError: nothing is wanted, or a step or a figure without what it needs.
        GuardError: too little is known there.
    """
    if not (wanted.facets or wanted.profile or wanted.roughness):
        raise SceneError("measure needs one or more of --facets, --profile X0 Y0 X1 Y1, --roughness")
    if wanted.step and not wanted.profile:
        raise SceneError("--step needs --profile X0 Y0 X1 Y1 across the step")
    if figure and not wanted.facets:
        raise SceneError("--figure draws the facets: give --facets, too")
    found: dict[str, Any] = {"reconstructed": reconstructed_area(rec)}
    lines = [f"reconstructed: {found['reconstructed']['share']:.1%} of the raster"]
    if wanted.facets:
        facets = find_facets(rec, FacetSettings(min_pixels=wanted.min_pixels))
        found["facets"] = facets.as_dict()
        lines += _facet_lines(facets)
        if figure:
            save_figure(facet_map(rec, facets.labels), figure)
    if wanted.profile:
        line = measure_profile(rec, wanted.profile[:2], wanted.profile[2:])
        found["profile"] = {
            "distance_um": line.distance.tolist(),
            "height_um": [None if math.isnan(h) else h for h in line.height],
            "height_std_um": None
            if line.height_std is None
            else [None if math.isnan(h) else h for h in line.height_std],
        }
        if wanted.step:
            step = measure_step(line)
            found["step"] = vars(step)
            lines.append(f"step: {step.height:.2f} +- {step.height_std:.2f} um at {step.position:.0f} um")
        else:
            lines += [f"{d:10.2f} {h:10.3f}" for d, h in zip(line.distance, line.height, strict=True)]
    if wanted.roughness:
        numbers = vars(measure_roughness(rec))
        found["roughness"] = {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in numbers.items()}
        units = {"Sa": "um", "Sq": "um", "Sz": "um", "Sdr": "%"}
        lines += [f"{name:<9} {value:12.5g} {units.get(name, '')}".rstrip() for name, value in numbers.items()]
    return found, lines


def reconstructed_area(rec: Reconstruction, max_std_um: float = 20.0) -> dict[str, Any]:
    """Return the share of the raster that is reconstructed: valid, and its height known to `max_std_um` if stated."""
    good = rec.is_valid & np.isfinite(rec.height)
    sure = good if rec.height_std is None else good & (rec.height_std <= max_std_um)
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
