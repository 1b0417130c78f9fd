"""One self-contained HTML report of a reconstruction: verdict, numbers, interactive figures, how it was made.

The page (`report_page`) holds plotly.js once and every figure (`interactive`) as JSON, so it opens offline and loads
nothing. What cannot be shown is left out with its reason. All text from files is escaped. Computes no scores.
"""

import base64
import html
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.errors import SceneError
from helio_jax.figures import canvas
from helio_jax.figures import interactive as draw
from helio_jax.figures import report_text as words
from helio_jax.figures.instrument_page import draw_instrument_views
from helio_jax.figures.interactive import Picture
from helio_jax.figures.plot_data import is_checkable, profiles
from helio_jax.figures.report_page import PAGE, SCRIPT, STYLE
from helio_jax.figures.summary import summarise
from helio_jax.figures.trust import (
    ANCHOR_TITLES,
    BAD,
    CARE,
    GOOD,
    anchor_rows,
    error_sources,
    limits,
    numbers,
    table,
    verdict,
)
from helio_jax.formats.safe import atomic_path
from helio_jax.measure.facets import Facets
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction
from helio_jax.scores.metrics import Scores, Truth, height_error

CITATION = (
    "A. Radić, S. Lambrick, C. Zhao et al., Heliometric stereo: a new frontier in surface profilometry, "
    "arXiv:2501.14833 (the method).",
    "helio_jax, version as given under provenance (this software).",
)


@dataclass(frozen=True)
class Measured:
    """What was measured on the heights for a report; a text says why something was not.

    Attributes:
        facets: planar facets.
        steps: record of `measure_steps` on the micrographs.
    """

    facets: Facets | str = "they were not measured: helio measure --facets"
    steps: Mapping[str, Any] | str = "they were not measured: helio measure --steps"


@dataclass(frozen=True)
class Section:
    """A section of the page: title, a note, HTML, and figures."""

    title: str
    note: str = ""
    text: str = ""
    pictures: list[Picture] = field(default_factory=list)


def write_report(
    path: str | Path,
    stack: MicrographStack | None,
    rec: Reconstruction,
    truth: Truth | None = None,
    scores: Scores | None = None,
    *,
    measured: Measured = Measured(),
    title: str = "Helium microscopy: height reconstruction",
) -> Path:
    """Write the report as one HTML file of less than 8 MB, atomically.

    Args:
        path: of the file to write.
        stack: micrographs, or None.
        rec: the reconstruction.
        truth: true heights on the same raster, for the error map and the profiles.
        scores: from `evaluate_height`.
        measured: facets and steps.
        title: heading of the page.

    Returns:
        The path.

    Raises:
        InputFileError, GuardError: the truth does not fit the reconstruction (see `height_error`).
        SceneError: the suffix is not .html, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise SceneError(f"{path}: a report is HTML: give it the suffix .html, got {path.suffix!r}")
    found = sections(stack, rec, truth, scores, measured)
    body, figures = [f"<h1>{html.escape(title)}</h1>", _headline(stack, rec), _contents(found)], {}
    for number, section in enumerate(found):
        note = f"<p>{words.escaped(section.note)}</p>" if section.note else ""
        body.append(f'<h2 id="section-{number}">{html.escape(section.title)}</h2>{note}')
        places = []
        for picture in section.pictures:
            place, alt = f"figure-{len(figures)}", html.escape(words.typeset(picture.alt))
            figures[place] = draw.figure_json(picture.figure)
            shown = f'<div id="{place}" class="{picture.kind}"></div>'
            places.append(f'<figure class="{picture.kind}" aria-label="{alt}">{shown}</figure>')
        body += [f'<div class="row">{"".join(places)}</div>'] if places else []
        body.append(section.text)
    data = "{" + ",".join(f"{json.dumps(k)}:{v}" for k, v in figures.items()) + "}"
    page = PAGE.format(
        title=html.escape(title),
        style=STYLE,
        body="\n".join(body),
        plotly=draw.plotly_script(),
        data=data.replace("<", "\\u003c"),
        script=SCRIPT,
    )
    with atomic_path(path) as part:
        part.write_text(page, encoding="utf-8")
    return path


def sections(
    stack: MicrographStack | None,
    rec: Reconstruction,
    truth: Truth | None,
    scores: Scores | None,
    measured: Measured = Measured(),
) -> list[Section]:
    """Make all sections of a report, in reading order."""
    error, level = (None, 0.0) if truth is None else height_error(rec, truth)
    residuals = rec.residuals if is_checkable(rec) else None
    n_maps = 3 + (error is not None) + (0 if residuals is None else len(residuals))
    n_values = n_maps * rec.height.size + (
        0 if stack is None else (1 + (stack.by_order is not None)) * stack.counts.size
    )
    step = draw.thinning_of(n_values, draw.MAX_MAP_VALUES)
    return [
        _instrument(rec),
        *_micrographs(stack, step),
        *_heights(rec, step),
        _profiles(rec, truth, level),
        *([] if error is None else [_errors(rec, error, scores, step)]),
        _uncertainty(rec, step),
        *_anchors(rec),
        Section("Validity and causes", "Why pixels are not valid.", words.causes(rec), [draw.validity_map(rec, step)]),
        _residuals(rec, residuals, step),
        _facets(measured.facets, rec),
        _steps(measured.steps, rec),
        _convergence(rec),
        Section("What was assumed", "", words.as_list(words.assumptions(rec))),
        Section("How it was made", "", words.made(rec, stack) + words.provenance(rec, stack, scores)),
        Section("How to cite", "", words.as_list(CITATION)),
    ]


def _headline(stack: MicrographStack | None, rec: Reconstruction) -> str:
    """Write verdict, warnings, and the numbers that a reader wants first."""
    word, reason = verdict(rec)
    tone = {GOOD: "good", CARE: "care", BAD: "bad"}[word]
    rows = [row for row in summarise(rec) if row[0] not in ("verdict", "WARNING", "beam", "made")]
    if stack is not None:
        about = dict(summarise(stack))
        rows.insert(2, ("micrographs", about["micrographs"]))
        rows.insert(3, ("counts of", about["counts of"]))
        rows[4:4] = [(label, text) for label, text in about.items() if label.startswith("- ")]
    rows.append(("limited by", "; ".join(limits(rec))))
    warned = [f'<p class="bad warning">Warning: {words.escaped(text)}.</p>' for text in rec.warnings]
    said = f'<p class="verdict {tone}">This height map is {words.escaped(word)}: {words.escaped(reason)}.</p>'
    return said + "".join(warned) + words.as_table(rows, about="headline numbers")


def _contents(found: list[Section]) -> str:
    links = (f'<a href="#section-{k}">{html.escape(section.title)}</a>' for k, section in enumerate(found))
    return f'<nav aria-label="contents">{" ".join(links)}</nav>'


def _instrument(rec: Reconstruction) -> Section:
    png = base64.b64encode(canvas.figure_png(draw_instrument_views(rec.instrument), dpi=90)).decode()
    names = ", ".join(rec.instrument.detector_names)
    alt = html.escape(f"plate with the apertures of {names} from above, and the beam from the side")
    image = f'<img alt="{alt}" src="data:image/png;base64,{png}">'
    text = f'<div class="scroll" role="region" tabindex="0" aria-label="drawing of the instrument">{image}</div>'
    return Section("Instrument", "", text + words.as_table(summarise(rec.instrument), about="instrument"))


def _thinned(step: int) -> str:
    return f" Thinned to 1 of {step} x {step} pixels; the data file holds all." if step > 1 else ""


def _micrographs(stack: MicrographStack | None, step: int) -> list[Section]:
    if stack is None:
        return [Section("Micrographs", "Left out: they were not given (helio report --stack FILE.h5).")]
    note = f"Over the beam positions, in {stack.unit} per pixel.{_thinned(step)}"
    out = [Section("Micrographs", note, "", draw.micrograph_maps(stack, step))]
    if multiple := draw.multiple_maps(stack, step):
        out.append(Section("Multiple scattering", f"Share of the counts.{_thinned(step)}", "", multiple))
    return out


def _heights(rec: Reconstruction, step: int) -> list[Section]:
    picture, apart = draw.height_map(rec)
    note = "In the beam frame, one pixel per beam position; the cursor reads the file's value."
    note += f" Contours every {apart:g} um." if apart else ""
    note += "" if rec.is_valid.all() else " Grey: not valid."
    note += " Cross: the highest valid point." if rec.is_valid.any() else ""
    note += _thinned(draw.thinning_of(rec.height.size, draw.MAX_HEIGHT_VALUES))
    albedo = draw.image_map(rec.raster_x, rec.raster_y, rec.albedo, "albedo", "(substrate = 1)", "Greys_r", step=step)
    out = [Section("Height", note, "", [picture, albedo])]
    about = "At the points' own positions, true to scale; drag to rotate. Gaps: not seen by the beam."
    return [*out, Section("Surface", about, "", [draw.surface(rec)])]


def _profiles(rec: Reconstruction, truth: Truth | None, level: float) -> Section:
    cuts = profiles(rec, None if truth is None else truth.height, level)
    if not cuts:
        return Section("Profiles", "Left out: no height is valid.")
    note = (
        "Through the highest valid point, in the sample frame; gaps where no height is valid or the beam does not see."
    )
    note += "" if truth is None else f" A level of {level:.3g} um is removed, as in the scores."
    return Section("Profiles", note, "", [draw.profile_plot(cut) for cut in cuts])


def _errors(rec: Reconstruction, error: np.ndarray, scores: Scores | None, step: int) -> Section:
    text = "" if scores is None else words.score_table(scores)
    return Section("Against the truth", _thinned(step).strip(), text, [draw.error_map(rec, error, step)])


def _uncertainty(rec: Reconstruction, step: int) -> Section:
    notes = words.uncertainty_notes(rec)
    if rec.height_std is None:
        return Section("Uncertainty", "Left out: the method gave no error bars.", notes)
    known = rec.height_std[rec.is_valid] if rec.is_valid.any() else rec.height_std
    style = {"colors": "Magma", "limits": (0.0, draw.robust_range(known, 2.0)[1]), "step": step}
    pictures = [draw.image_map(rec.raster_x, rec.raster_y, rec.height_std, "standard deviation", "um", **style)]
    if sources := error_sources(rec):
        names, values = zip(*sources, strict=True)
        pictures.append(draw.bar_plot("share in the s.d. of the highest point", names, values, "um"))
    return Section("Uncertainty", f"One standard deviation of each height.{_thinned(step)}", notes, pictures)


def _anchors(rec: Reconstruction) -> list[Section]:
    rows = anchor_rows(rec)
    note = (
        "What was stated of the heights, or measured by mask bands, and what the data, the priors and the other "
        "anchors say without it."
    )
    return [Section("Anchors", note, words.as_table(rows, ANCHOR_TITLES, "anchors"))] if rows else []


def _residuals(rec: Reconstruction, residuals: np.ndarray | None, step: int) -> Section:
    pictures = [] if residuals is None else draw.residual_maps(rec, residuals, step)
    if residuals is not None:
        note = f"(data - model) / standard deviation of each detector.{_thinned(step)}"
    elif rec.residuals is None:
        note = "Residuals are left out: the file holds none."
    else:
        note = (
            "Residuals are left out: three images determine the three unknowns of each pixel, nothing is left to check."
        )
    if rec.chi_square is not None:
        style = {"colors": "Magma", "limits": (0.0, 5.0), "step": step}
        chi = draw.image_map(rec.raster_x, rec.raster_y, rec.chi_square, "chi-square, traced", "", **style)
        pictures.append(chi)
        note += (
            " The traced map: micrographs traced on the finished heights against the data, mean square of 3 x 3 pixels."
        )
    else:
        note += " The data have not been tested against micrographs traced on this map."
    return Section("Residuals and chi-square", note, words.chi_square_table(rec, residuals), pictures)


def _facets(found: Facets | str, rec: Reconstruction) -> Section:
    if isinstance(found, str):
        return Section("Facets", f"Left out: {found}.")
    note = "Planar pieces of the surface; one that is curved falls into several."
    return Section("Facets", note, words.facet_tables(found, rec.height.size))


def _steps(found: Mapping[str, Any] | str, rec: Reconstruction) -> Section:
    assumed = table(rec.provenance).get("assumed")
    taken = f" The fit took {assumed}." if isinstance(assumed, str) and "mask bands" in assumed else ""
    if isinstance(found, str):
        return Section("Steps", f"Left out: {found}.{taken}")
    if not found["steps"]:
        return Section("Steps", f"None: no straight edge with mask bands was found.{taken}")
    return Section("Steps", f"Heights of walls from the mask bands of the micrographs.{taken}", words.step_table(found))


def _convergence(rec: Reconstruction) -> Section:
    changes = table(rec.provenance).get("height_changes_um")
    changes = changes if isinstance(changes, list) else []
    if not changes or not all(isinstance(c, (int, float)) and c > 0 for c in changes):
        return Section("Convergence", f"Left out: {rec.method} solves a stated number of times, nothing converges.")
    tolerance = numbers(rec.provenance, "reconstruct", "refine").get("tolerance_um")
    return Section("Convergence", rec.status, "", [draw.convergence_plot(changes, tolerance)])
