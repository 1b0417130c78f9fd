"""What a person wants to know about micrographs, heights, an instrument or a scene, in about ten lines.

Rows of (label, text) for `helio info`, for the end of `helio simulate` and `helio import`, and for notebooks. Units in
plain text: um, deg.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.figures.image_numbers import image_numbers
from helio_jax.figures.plot_data import highest_valid
from helio_jax.figures.trust import table, trust_rows, verdict_text
from helio_jax.figures.wording import UNITS, amount, angle, duration, length, lengths, plural, share, short
from helio_jax.heightmap import HeightMap
from helio_jax.instrument import Instrument
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.reconstruction import Reconstruction
from helio_jax.scene.scene import Scene

Rows = list[tuple[str, str]]
MAX_SCANS = 8
"""A summary lists at most this many scans of a set."""
KINDS = {"expected": "expected counts", "poisson": "counts with noise", "measured": "measured counts"}
"""What the counts of a stack are, by `MicrographStack.noise`."""


def summarise(what: Any) -> Rows:
    """Summarise a stack, set, reconstruction, height map, instrument or scene as rows of (label, text)."""
    match what:
        case MicrographStack():
            return _stack_rows(what)
        case MicrographSet():
            return _set_rows(what)
        case Reconstruction():
            return _reconstruction_rows(what)
        case HeightMap():
            return _height_map_rows(what)
        case Scene():
            return _scene_rows(what)
        case Instrument():
            return _instrument_rows(what)
    raise TypeError(f"there is no summary of a {type(what).__name__}")


def text_lines(rows: Rows) -> list[str]:
    """Format rows as aligned lines."""
    width = max((len(label) for label, _ in rows), default=0)
    return [f"  {label:<{width}}  {text}" for label, text in rows]


_FAULTS = {
    "n_edges_of_three_faces": "edges that three or more triangles share",
    "n_faces_without_area": "triangles without area",
    "n_duplicate_faces": "triangles that are there twice",
}
"""Faults of a mesh that are counted (`scene.sample.check_body`), in words."""


def body_lines(body: dict[str, Any], name: str) -> list[str]:
    """Write how large a surface is and of what, and its faults (`scene.sample.check_body`)."""
    low, high = body["bounds_um"]
    sides = " x ".join(f"{b - a:g}" for a, b in zip(low, high, strict=True))
    parts = [plural(body[f"n_{kind}s"], noun) for kind, noun in (("face", "triangle"), ("sphere", "sphere"))]
    parts = [text for text, n in zip(parts, (body["n_faces"], body["n_spheres"]), strict=True) if n]
    out = [f"{name}{', '.join(parts)}; {sides} um, z from {low[2]:g} to {high[2]:g} um"]
    if body["is_inside_out"]:
        out.append("inside out: set sample.flip_normals = true")
    if not body["is_winding_consistent"]:
        out.append("neighbouring triangles face opposite ways: repair the mesh")
    counted = [(body[key], noun) for key, noun in _FAULTS.items()]
    return out + [f"{noun}: {n}" for n, noun in counted if n]


def hole_lines(body: dict[str, Any]) -> list[str]:
    """Write where the holes of a sample's mesh are, and what to do (`scene.sample.check_body`)."""
    if not body["n_holes"]:
        return []
    largest = body["holes"][0]["size_um"]
    out = [
        f"rays leak through {plural(body['n_holes'], 'hole')}: close them in the mesh, or set sample.close_holes_um "
        f"(the largest is {largest:g} um across); a sheet without thickness needs sample.two_sided = true"
    ]
    for hole in body["holes"]:
        place = ", ".join(f"{v:g}" for v in hole["middle_um"])
        out.append(f"  hole {hole['size_um']:g} um across, middle at {place} um, {hole['n_edges']} edges")
    n_more = body["n_holes"] - len(body["holes"])
    return [*out, f"  and {n_more} smaller"] if n_more else out


def aims(instrument: Instrument) -> list[str]:
    """Write where each detector's opening lies, e.g. polar 30 deg, azimuth 120 deg."""
    found = [detector.aim(instrument.working_distance) for detector in instrument.detector]
    return [
        "a part of the plate's mesh" if aim is None else f"polar {angle(aim[0])}, azimuth {angle(aim[1])}"
        for aim in found
    ]


def raster_text(x: np.ndarray, y: np.ndarray) -> str:
    """Write size, pixel and field of a raster."""
    dx, dy = pitch(x), pitch(y)
    field = lengths(dx * x.size, dy * y.size)
    return f"{x.size} x {y.size} pixels of {lengths(dx, dy)}; field of view {field}"


def _stack_rows(stack: MicrographStack) -> Rows:
    rows = [
        ("micrographs", f"{stack.name}: {plural(stack.shape[0], 'image')}, {KINDS[stack.noise]}"),
        _raster_row(stack),
    ]
    rows.append(("counts of", _exposure(stack)))
    rows += _detector_rows(stack)
    shares = [f"{name} {share(part)}" for name, part in stack.count_fractions().items()]
    rows += [("of the counts", ", ".join(shares))] if shares else []
    rows.append(("beam", _beam_text(stack.instrument)))
    if stack.sample_rotation:
        rows.append(("sample", f"rotated by {angle(stack.sample_rotation)}"))
    if stack.noise == "measured":
        done = (
            "no (helio calibrate)"
            if stack.calibration is None
            else f"yes, by {stack.calibration.method.replace('_', ' ')}"
        )
        rows.append(("calibrated", done + (", aligned scans" if stack.alignment is not None else "")))
    if not stack.is_observed.all():
        rows.append(("observed", f"{share(float(stack.is_observed.mean()))} of the pixels"))
    return rows + _made_rows(stack.provenance)


def _raster_row(stack: MicrographStack) -> tuple[str, str]:
    if stack.positions is not None:
        return "positions", f"a list of {len(stack.positions)}"
    return "raster", raster_text(stack.x, stack.y)


def _exposure(stack: MicrographStack) -> str:
    per_pixel = _exposure_per_pixel(stack)
    if stack.dwell_map is None:
        return per_pixel
    times = stack.dwell_map[stack.is_observed.any(0)]
    low, high = (float(f(times)) for f in (np.min, np.max)) if times.size else (0.0, 0.0)
    return f"{per_pixel}, scaled from dwell times of {low:.3g} to {high:.3g} s ({duration(float(times.sum()))} in all)"


def _exposure_per_pixel(stack: MicrographStack) -> str:
    if stack.n_rays is not None:
        unit = "" if stack.unit in UNITS else f" (unit: {stack.unit})"
        return f"{plural(stack.n_rays, 'beam atom')} per pixel{unit}"
    if not stack.dwell:
        return "an unknown exposure"
    total = duration(stack.dwell * stack.shape[1] * stack.shape[2])
    return f"{stack.dwell:.3g} s per pixel ({total} for one image, without the time to move)"


def _detector_rows(stack: MicrographStack) -> Rows:
    rows = []
    names, unit = stack.instrument.detector_names, stack.unit if stack.unit in UNITS else ""
    for name, aim, found in zip(names, aims(stack.instrument), image_numbers(stack), strict=True):
        text = f"{aim}; mean {amount(found.mean, unit)}, max {amount(found.highest, unit)}"
        if found.relative_error is not None and stack.noise == "expected":
            text += f", error of the simulation {share(found.relative_error)}"
        elif found.noise is not None:
            text += f", noise {amount(found.noise, unit)}"
        if found.snr is not None:
            text += f", SNR {found.snr:.3g}" + (" if counted" if stack.noise == "expected" else "")
        rows.append((f"- {name}", text))
    return rows


def _set_rows(scans: MicrographSet) -> Rows:
    first = scans.stacks[0]
    rows = [("scans", f"{len(scans.stacks)}, {KINDS[first.noise]}"), _raster_row(first)]
    rows += [("counts of", _exposure(first)), ("beam", _beam_text(first.instrument))]
    for stack in scans.stacks[:MAX_SCANS]:
        means = ", ".join(amount(found.mean, stack.unit) for found in image_numbers(stack))
        where = f"sample at {angle(stack.sample_rotation)}, {length(stack.instrument.sample_distance)} below the plate"
        rows.append((f"- {stack.name}", f"{where}; mean {means}"))
    if len(scans.stacks) > MAX_SCANS:
        rows.append(("- ...", f"{len(scans.stacks) - MAX_SCANS} more"))
    made = [(f"{label} (first)", text) for label, text in _made_rows(first.provenance)]
    return rows + (_made_rows(scans.provenance) or made)


def _reconstruction_rows(rec: Reconstruction) -> Rows:
    rows = [("height map", f"by {rec.method} from {plural(len(rec.instrument.detector), 'image')}")]
    rows.append(("verdict", verdict_text(rec)))
    rows.append(("raster", f"{raster_text(rec.raster_x, rec.raster_y)} (beam frame)"))
    rows.append(("highest point", highest_text(rec)))
    if rec.is_valid.any():
        heights = rec.height[rec.is_valid & np.isfinite(rec.height)]
        low, high = float(heights.min()), float(heights.max())
        rows.append(("heights", f"{low:.4g} to {high:.4g} um above {_level(rec)}: relief {high - low:.4g} um"))
    if rec.height_std is not None and rec.is_valid.any():
        rows.append(("standard dev.", f"{np.nanmedian(rec.height_std[rec.is_valid]):.3g} um (median of valid heights)"))
    rows += trust_rows(rec.trust)
    rows += [("WARNING", "; ".join(rec.warnings))] if rec.warnings else []
    rows += [("status", rec.status)] if rec.status else []
    return [*rows, ("beam", _beam_text(rec.instrument)), *_made_rows(table(rec.provenance, "stack"))]


def highest_text(rec: Reconstruction) -> str:
    """Write the highest valid height with its standard deviation and its place in the sample frame."""
    top = highest_valid(rec)
    if top is None:
        return "none: no height is valid"
    z, std = rec.height[top], None if rec.height_std is None else rec.height_std[top]
    error = "" if std is None or not np.isfinite(std) else f" +- {std:.{0 if std >= 10 else 1}f}"
    return f"{z:.4g}{error} um at x = {rec.x[top] + 0.0:.0f} um, y = {rec.y[top] + 0.0:.0f} um (of the valid ones)"


def _level(rec: Reconstruction) -> str:
    return "the substrate" if rec.border == "flat" else "an unknown level (free border)"


def _height_map_rows(found: HeightMap) -> Rows:
    known = found.height[np.isfinite(found.height)]
    rows = [("height map", "on a regular grid, sample frame"), ("grid", raster_text(found.x, found.y))]
    if not known.size:
        return [*rows, ("heights", "none: all are missing")]
    rows.append(("heights", f"{known.min():.4g} to {known.max():.4g} um, median {np.median(known):.4g} um"))
    if n_missing := found.height.size - known.size:
        rows.append(("missing", f"{n_missing} of {found.height.size} heights"))
    return rows


def _beam_text(instrument: Instrument) -> str:
    t, phi = instrument.beam.incidence_deg, instrument.beam.azimuth_deg
    way = f"{t:g} deg from the plate normal, travels towards azimuth {phi:g} deg" if t else "along the plate normal"
    design, distance = instrument.working_distance, instrument.sample_distance
    aimed = f" (aimed at {length(design)})" if design != distance else ""
    return f"{way}; substrate {length(distance)} below the plate{aimed}"


def _instrument_rows(instrument: Instrument) -> Rows:
    beam, plate = instrument.beam, instrument.plate
    size = "" if beam.source in ("pencil", "rays") else f" of {beam.source_size_mrad:g} mrad"
    rows = [("beam", _beam_text(instrument))]
    rows.append(("source", f"{beam.source}{size}, pinhole radius {length(beam.pinhole_radius_um)}"))
    rows.append(("plate", plate.kind))
    for detector, aim in zip(instrument.detector, aims(instrument), strict=True):
        channel = "" if detector.channel is None else f", channel {detector.channel}"
        rows.append((f"- {detector.name}", aim + (", at infinity" if detector.at_infinity else "") + channel))
    stated = {k: v for k, v in instrument.uncertainty.model_dump().items() if v}
    said = ", ".join(
        f"{k.rpartition('_')[0].replace('_', ' ')} {v:g} {k.rpartition('_')[2]}" for k, v in stated.items()
    )
    rows.append(("uncertainty", said or "none stated: the geometry counts as exact"))
    if (readout := instrument.readout) is not None:
        error = max(d.std[0] / d.signal for d in readout.detector)
        place = "" if readout.stage_um else ", stage position unknown"
        rows.append(("read-out", f"background of a campaign, known to {share(error)} of the signal{place}"))
    if (law := instrument.law) is not None:
        rows.append(("law", f"cos^(1 + m) with m = {law.exponent:.3g} +- {law.std:.2g}"))
    return rows


def _scene_rows(scene: Scene) -> Rows:
    (x0, y0, z0), (x1, y1, z1) = scene.build_body().bounds
    rows = [("scene", scene.name + (f": {scene.description.strip()}" if scene.description.strip() else ""))]
    file = getattr(scene.sample, "file", None)
    kind = scene.sample.kind + (f" from {file}" if file else "")
    heights = f"from {length(z0)} to {length(z1)} above the substrate"
    rows.append(("sample", f"{kind}, {lengths(x1 - x0, y1 - y0)} wide, {heights}"))
    laws = ", ".join(f"{name} ({law.kind})" for name, law in scene.used_materials.items())
    rows.append(("materials", laws or "all scatter by the cosine law"))
    ny, nx = scene.image_shape
    raster = (
        raster_text(*scene.positions()) if scene.scan.kind == "raster" else f"{scene.scan.kind} of {nx * ny} positions"
    )
    views = f"; {scene.scan.n_views} views" if scene.scan.n_views > 1 else ""
    return [*rows, ("scan", raster + views), *_instrument_rows(scene.instrument)]


def _made_rows(provenance: Any) -> Rows:
    """Write where the data come from, as far as their history states it; the history of a file may hold anything."""
    source, scan = table(provenance, "source"), table(provenance, "metadata", "meas_list")
    trace, versions = table(provenance, "scene", "trace"), table(provenance, "versions")
    parts = [f"imported from {source.get('file')} ({source.get('kind')})"] if source else []
    if isinstance(took := scan.get("scan_time"), (int, float)):
        parts.append(f"scanned in {duration(took)}")
    if "scene_file" in provenance:
        parts.append(f"simulated from {provenance['scene_file']}")
    if trace:
        parts.append(
            f"{trace.get('estimator')} estimator, {trace.get('rays')} rays per pixel, seed {trace.get('seed')}"
        )
    parts += [f"helio_jax {versions['helio-jax']}"] if "helio-jax" in versions else []
    parts += [str(provenance["time"])] if "time" in provenance else []
    return [("made", short(", ".join(parts), 300))] if parts else []


def known_shape_lines(record: Mapping[str, Any]) -> list[str]:
    """Format what `calibrate_known_files` returns for a terminal."""
    readout, chi = record["readout"], record["regions"]
    out = _parameter_lines(record["table"])
    out += ["", "  detector       substrate's signal       offset     lines     noise   (counts)"]
    for row in readout:
        out.append(
            f"  {row['detector']:<14} {row['substrate_signal']:>18.4g} {row['offset']:>12.5g} {row['line_std']:>9.3g} "
            f"{row['noise']:>9.3g}   {row['scan']}"
        )
    out += ["", "  chi-square per pixel, robust (mean)"]
    for row in chi:
        place = f"{row['region']:<10} {row['detector']:<14}"
        out.append(f"  {place} {row['robust']:>7.2f} ({row['mean']:.2f}), {row['pixels']} pixels   {row['scan']}")
    out += ["", f"  robust chi-square {record['robust_chi_square']:.2f} per pixel; {record['rounds']} rounds"]
    out += [f"  {sentence}" for sentence in record["verdict"]]
    return out + list(record["files"])


def mask_lines(record: Mapping[str, Any]) -> list[str]:
    """Format what `calibrate_known_files` returns of directions by masks for a terminal."""
    out = ["directions of the apertures as the spot sees them; pull: (value - stated) / s.d."]
    out += [*_parameter_lines(record["directions"]), "", "all unknowns; pull: (value - stated) / prior s.d."]
    out += _parameter_lines(record["table"])
    out += ["", f"  robust chi-square {record['robust_chi_square']:.2f} per pixel; {record['rounds']} rounds"]
    return [*out, *(f"  {sentence}" for sentence in record["verdict"]), *record["files"]]


def _parameter_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Format a table of fitted parameters."""
    width = max(len(row["name"]) for row in rows)
    out = [f"  {'':<{width}} {'value':>10} {'s.d.':>9} {'stated':>10} {'prior s.d.':>10} {'pull':>6}"]
    for row in rows:
        numbers = f"{row['value']:>10.5g} {row['std']:>9.3g} {row['stated']:>10.5g} {row['prior']:>10.3g}"
        loose = "" if row["is_determined"] else "  not determined"
        out.append(f"  {row['name']:<{width}} {numbers} {row['pull']:>6.1f} {row['unit']}{loose}")
    return out
