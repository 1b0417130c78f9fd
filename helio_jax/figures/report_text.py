"""What the HTML report says in words and tables: causes, chi-square, facets, steps, assumptions, how it was made.

Every function returns HTML; all text from files is escaped. Computes nothing but shares and means.
"""

import html
import json
import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from helio_jax.figures.trust import discrepancy_text, error_sources, numbers, table
from helio_jax.figures.wording import share, typeset
from helio_jax.measure.facets import Facets
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction
from helio_jax.scores.metrics import Scores
from helio_jax.validity import MEANINGS, REASONS, VALID_RULE

MAX_ROWS = 12
"""Facets, edges or steps that are listed at most."""
MAX_TEXT = 60_000
"""Letters of one part of the provenance that are shown."""
_SMALLEST_FACET = 0.01
"""A facet with a smaller share of the pixels is not listed."""


def escaped(text: Any) -> str:
    """Escape a text and typeset its numbers; a unit stays with its number."""
    return html.escape(re.sub(r"(?<=\d) (?=%|µm|mm)", "\u00a0", typeset(str(text))))


def as_table(rows: Sequence[Sequence[Any]], head: Sequence[str] = (), about: str = "") -> str:
    """Write rows as a table: first column a heading, other columns right-aligned where they have a head."""
    kind = ' class="number"' if head else ""
    top = "".join(f'<th scope="col"{kind if k else ""}>{escaped(text)}</th>' for k, text in enumerate(head))
    lines = [f"<tr>{top}</tr>"] if head else []
    for label, *cells in rows:
        texts = "".join(f"<td{kind}>{escaped(cell)}</td>" for cell in cells)
        lines.append(f'<tr><th scope="row">{escaped(label)}</th>{texts}</tr>')
    label = f' role="region" tabindex="0" aria-label="{html.escape(about)}"' if about else ""
    return f'<div class="scroll"{label}><table>{"".join(lines)}</table></div>'


def as_list(items: Sequence[str]) -> str:
    """Write sentences as a list."""
    return "<ul>" + "".join(f"<li>{escaped(item)}</li>" for item in items) + "</ul>"


def score_table(scores: Scores) -> str:
    """Write the scores against the truth."""
    note = "<p>Percentages of heights are fractions of the known height H.</p>"
    rows = [(label, f"{value} {unit}") for label, value, unit in scores.as_table()]
    return as_table(rows, ("score against the truth", "value"), "scores") + note


def causes(rec: Reconstruction) -> str:
    """Write the rule of validity, and the share and meaning of every reason that occurs."""
    rows = []
    for k, reason in enumerate(REASONS):
        part = float(np.mean(rec.reason == k))
        if part:
            rows.append((reason, share(part), MEANINGS[reason]))
    return f"<p>The rule: {escaped(VALID_RULE)}.</p>" + as_table(rows, about="causes")


def uncertainty_notes(rec: Reconstruction) -> str:
    """List what the error bars of a fit rest on: read-out, weakly determined combinations, common errors."""
    found = table(rec.provenance, "instrument")
    notes = [f"{name}: {um:.3g} um of the highest point" for name, um in error_sources(rec)[:4]]
    weak = found.get("weak")
    for one in weak[:3] if isinstance(weak, list) else []:
        terms = ", ".join(f"{factor:+.2f} {name.removeprefix('log_')}" for name, factor in numbers(one, "of").items())
        left = numbers({"share": table(one).get("share")}).get("share", math.nan)
        notes.append(f"weakly determined, posterior over prior standard deviation {share(left)}: {terms}")
    common = numbers(found).get("common_mode_um", 0.0)
    notes += [f"an error common to all heights of up to {common:.3g} um is included"] if common else []
    notes += [text] if (text := discrepancy_text(rec)) else []
    return as_list(notes) if notes else ""


def chi_square_table(rec: Reconstruction, residuals: np.ndarray | None) -> str:
    """Write the chi-square of every detector: of the fit's residuals, and of micrographs traced on the finished map."""
    traced = numbers(rec.provenance, "traced_chi_square")
    rows = []
    for k, name in enumerate(rec.instrument.detector_names):
        row = [name]
        if residuals is not None:
            known = residuals[k][np.isfinite(residuals[k])]
            row += [f"{np.mean(known**2):.2f}", share(float(np.mean(np.abs(known) > 3)))] if known.size else ["-", "-"]
        rows.append([*row, f"{traced[name]:.2f}"] if traced.keys() >= {name} else [*row, "not tested"])
    fitted = () if residuals is None else ("chi-square of the fit", "beyond 3 s.d.")
    return as_table(rows, ("detector", *fitted, "chi-square of the traced map"), "chi-square by detector")


def facet_tables(found: Facets, n_pixels: int) -> str:
    """Write the largest facets and their edges."""
    shown = [f for f in found.facets if f.n_pixels >= _SMALLEST_FACET * n_pixels][:MAX_ROWS]
    rows = [
        (
            f"{f.number}",
            f"{f.tilt_deg:.1f}",
            f"{f.azimuth_deg:.1f}",
            f"{f.area_um2 / 1e6:.4f} +- {f.area_std_um2 / 1e6:.4f}",
            f"{f.long_um:.0f} x {f.short_um:.0f}",
            f"{f.rms_um:.2g}" + (", cut by the border" if f.is_cut else ""),
        )
        for f in shown
    ]
    head = ("facet", "tilt (deg)", "azimuth (deg)", "area (mm²)", "sides (µm)", "rms (µm)")
    text = as_table(rows, head, "facets")
    numbers_shown = {f.number for f in shown}
    edges = [e for e in found.edges if set(e.facets) <= numbers_shown][:MAX_ROWS]
    lines = [
        (f"{e.facets[0]} - {e.facets[1]}", f"{e.angle_deg:.2f} +- {e.angle_std_deg:.2f}", f"{e.length_um:.0f}")
        for e in edges
    ]
    if lines:
        text += as_table(lines, ("edge of facets", "angle (deg)", "length (µm)"), "edges of facets")
    n_hidden = len(found.facets) - len(shown)
    return text + (f"<p>{n_hidden} smaller ones are not listed (helio measure --facets).</p>" if n_hidden else "")


def step_table(record: Mapping[str, Any]) -> str:
    """Write the steps of a record of `measure_steps`."""
    rows = []
    for step in record["steps"][:MAX_ROWS]:
        height, std = step["height_um"], step["height_std_um"]
        sign = ">= " if step["is_lower_bound"] else ""
        said = "-" if height is None else f"{sign}{height:.2f} +- {std:.2f}"
        rows.append((step["number"], said, f"{step['falls_deg']:+.0f}", f"{step['p_wall']:.2f}", step["note"]))
    return as_table(rows, ("step", "height (µm)", "falls towards (deg)", "probability of a wall", "note"), "steps")


def assumptions(rec: Reconstruction) -> list[str]:
    """List what the method took for granted."""
    how = table(rec.provenance, "reconstruct")
    fit, assumed = table(how, "refine"), table(rec.provenance).get("assumed")
    found = [f"assumed: {assumed if isinstance(assumed, str) and assumed else 'nothing beyond the settings'}"]
    flat = "the border of the image lies on the substrate, from which heights count"
    found.append(flat if rec.border == "flat" else "nothing in the image is on the substrate: the level is unknown")
    is_fit = rec.method == "refine"
    found.append(law_of(rec))
    if not is_fit:
        return [*found, "the albedo of each pixel is free; gains and offsets are as stated or calibrated"]
    stated = numbers(fit) | numbers(table(rec.provenance, "readout_priors"))
    known = {name: stated.get(name, 0.0) for name in ("gain_std", "offset_std", "albedo_std", "drift_std")}
    albedo = f"varies smoothly within {known['albedo_std']:g}" if known["albedo_std"] else "is that of the substrate"
    found.append(f"the albedo {albedo}, except in the patches that were found")
    gain, offset = share(known["gain_std"]), share(known["offset_std"])
    found.append(f"gains are right within {gain}, offsets within {offset} of the signal")
    return found


def law_of(rec: Reconstruction) -> str:
    """Say by which law the sample was taken to scatter; of a fitted one, whether it came out as the cosine law."""
    law = table(rec.provenance, "instrument", "law")
    if not law:
        return "surfaces scatter by the cosine law"
    if law.get("kind") == "as_stated":
        exponent, std = (numbers(law).get(key, math.nan) for key in ("exponent", "std"))
        return f"surfaces scatter by the law of the instrument file, cos^(1 + m) with m = {exponent:.3g} +- {std:.2g}"
    kind, judged = str(law.get("kind")).replace("_", " "), "compatible" if law.get("is_cosine") else "NOT compatible"
    if "is_cosine" not in law:
        found = ", ".join(f"{name} {value:.3g}" for name, value in numbers(law, "numbers").items())
        return f"surfaces scatter by a {kind} law, whose numbers were fitted, without error bars: {found}"
    chance = numbers(law).get("cosine_probability", math.nan)
    return (
        f"surfaces scatter by a {kind} law, whose numbers were fitted: {judged} with the cosine law (probability "
        f"{chance:.2g})"
    )


def made(rec: Reconstruction, stack: MicrographStack | None) -> str:
    """Write how the micrographs and the height map were made: commands, versions, seed, book-keeping of the atoms."""
    origin = dict(stack.provenance) if stack is not None else table(rec.provenance, "stack")
    rows = [("micrographs", text) for text in _run_of(origin)] + [
        ("height map", text) for text in _run_of(rec.provenance)
    ]
    trace, rays = table(origin, "trace"), numbers(origin, "rays")
    if trace:
        said = ", ".join(f"{name} {trace[name]}" for name in ("estimator", "rays", "seed") if name in trace)
        rows.append(("tracing", said))
    noise = table(origin, "noise")
    if noise.get("enabled"):
        rows.append(("noise", f"{noise.get('law', 'poisson')}, seed {noise.get('seed')}"))
    if "launched" in rays:
        parts = {name: rays.get(name, 0.0) for name in ("detected", "escaped", "stopped", "lost")}
        sum_ = " + ".join(f"{n:,.0f} {name}" for name, n in parts.items())
        sign = "=" if sum(parts.values()) == rays["launched"] else "IS NOT"
        rows.append(("book-keeping", f"{rays['launched']:,.0f} atoms launched {sign} {sum_}"))
    return as_table(rows, about="how it was made") if rows else "<p>The files do not state it.</p>"


def _run_of(history: Mapping[str, Any]) -> list[str]:
    """Write command, time, versions and commit of one run."""
    command, versions = history.get("command"), table(history, "versions")
    found = [" ".join(map(str, command))] if isinstance(command, list) else []
    source = table(history, "source")
    found += [f"imported from {source.get('file')} ({source.get('kind')})"] if source else []
    found += [", ".join(f"{name} {version}" for name, version in versions.items())] if versions else []
    when = [f"{label} {history[key]}" for label, key in (("at", "time"), ("commit", "git")) if history.get(key)]
    return found + ([", ".join(when)] if when else [])


def provenance(rec: Reconstruction, stack: MicrographStack | None, scores: Scores | None) -> str:
    """Write resolved scene, settings and the rest of the provenance, folded."""
    history = {**rec.provenance}
    origin = history.pop("stack", {})
    origin = {**(stack.provenance if stack is not None else origin if isinstance(origin, Mapping) else {})}
    parts: dict[str, Any] = {"resolved scene": origin.pop("scene", None), "scene file": origin.pop("scene_text", None)}
    parts["settings of the reconstruction"] = history.pop("reconstruct", None)
    for name in ("gain", "offset"):
        value = getattr(rec, name)
        if value is not None:
            parts[name] = dict(zip(rec.instrument.detector_names, value.tolist(), strict=True))
    parts["instrument"] = rec.instrument.model_dump(mode="json", exclude_none=True)
    parts["history of the micrographs"], parts["history of the height map"] = origin, history
    parts["scores"] = None if scores is None else scores.as_dict()
    out = []
    for name, value in parts.items():
        if value:
            text = value if isinstance(value, str) else json.dumps(value, indent=2, default=str, ensure_ascii=False)
            cut = "" if len(text) <= MAX_TEXT else "\n... (the data file holds all)"
            shown = html.escape(text[:MAX_TEXT] + cut)
            out.append(f'<details><summary>{name}</summary><pre tabindex="0">{shown}</pre></details>')
    return "".join(out)
