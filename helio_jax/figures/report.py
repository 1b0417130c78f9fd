"""One self-contained HTML report of a reconstruction: numbers, interactive maps, 3-D surface, provenance.

The page holds plotly.js once and every figure (`interactive`) as JSON, so it opens offline and loads nothing. Figures
are drawn when scrolled to, in the colours of the reader's light or dark scheme. All text from files is escaped.
Computes no scores.
"""

import base64
import html
import json
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.errors import InputFileError, SceneError
from helio_jax.figures.interactive import figure_json, plotly_script, report_groups
from helio_jax.formats.safe import atomic_path
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction
from helio_jax.scores.metrics import Scores, Truth

CITATION = (
    "A. Radić, S. Lambrick, C. Zhao et al., Heliometric stereo: a new frontier in surface profilometry, "
    "arXiv:2501.14833 (the method).",
    "helio_jax, version as given under provenance (this software).",
)


def write_report(
    path: str | Path,
    stack: MicrographStack | None,
    rec: Reconstruction,
    truth: Truth | None = None,
    scores: Scores | None = None,
    *,
    panel_png: bytes | str | Path | None = None,
    title: str = "Helium microscopy: height reconstruction",
) -> Path:
    """Write the report as one HTML file, atomically.

    Args:
        path: of the file to write.
        stack: micrographs, or None.
        rec: the reconstruction.
        truth: true heights on the same raster, for the error map and the profiles.
        scores: from `evaluate_height`.
        panel_png: the printed panel to embed, as bytes or as a file.
        title: heading of the page.

    Returns:
        The path.

    Raises:
        InputFileError: the truth has another raster, or the panel cannot be read or is not a PNG.
        SceneError: the suffix is not .html, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise SceneError(f"{path}: a report is HTML: give it the suffix .html, got {path.suffix!r}")
    sections, figures = _sections(stack, rec, truth)
    body = [f"<h1>{html.escape(title)}</h1>", _headline(stack, rec), _score_table(rec, scores)]
    body += sections
    if panel_png is not None:
        body.append(f'<h2>Panel</h2><img alt="Printed panel" src="data:image/png;base64,{_read_png(panel_png)}">')
    body += [_provenance(stack, rec, scores), "<h2>How to cite</h2><ul>"]
    body += [f"<li>{html.escape(line)}</li>" for line in CITATION] + ["</ul>"]
    data = "{" + ",".join(f"{json.dumps(k)}:{v}" for k, v in figures.items()) + "}"
    page = _PAGE.format(
        title=html.escape(title),
        style=_STYLE,
        body="\n".join(body),
        plotly=plotly_script(),
        data=data.replace("<", "\\u003c"),
        script=_SCRIPT,
    )
    with atomic_path(path) as part:
        part.write_text(page, encoding="utf-8")
    return path


def _read_png(panel: bytes | str | Path) -> str:
    """Return a PNG as base64 text."""
    try:
        data = panel if isinstance(panel, bytes) else Path(panel).read_bytes()
    except OSError as e:
        raise InputFileError(f"the panel {panel} cannot be read: {e.strerror}") from None
    if not data.startswith(b"\x89PNG"):
        raise InputFileError(f"the panel must be a PNG file, got {len(data)} bytes of something else")
    return base64.b64encode(data).decode()


def _headline(stack: MicrographStack | None, rec: Reconstruction) -> str:
    """Return one paragraph: scan, instrument, method, and the status of the reconstruction."""
    rows, columns = rec.height.shape
    facts = [
        f"{columns} x {rows} pixels",
        f"{len(rec.instrument.detector)} detectors",
        f"incidence {rec.instrument.beam.incidence_deg:g}°",
        f"method {rec.method}",
    ]
    if stack is not None:
        facts.insert(0, f"{stack.name} ({stack.noise})")
    status = f"<br>{html.escape(rec.status)}" if rec.status else ""
    if rec.is_contradicted:
        status = f'<br><strong class="warning">Warning: the data contradict this height map.</strong>{status}'
    return f'<p class="facts">{html.escape(" · ".join(facts))}{status}</p>'


def _score_table(rec: Reconstruction, scores: Scores | None) -> str:
    """Return the scores as a table; without scores, the fraction of valid pixels."""
    valid = 100 * float(np.mean(rec.is_valid & np.isfinite(rec.height)))
    rows = [("valid pixels", f"{valid:.1f}", "%")] if scores is None else scores.as_table()
    lines = []
    for label, value, unit in rows:
        shown = unit.replace("um", "µm").replace("deg", "°")
        lines.append(f"<tr><th>{html.escape(label)}</th><td><b>{value}</b></td><td>{shown}</td></tr>")
    note = "" if scores is None else "<p>Percentages of heights are fractions of the known height H.</p>"
    return f"<h2>Numbers</h2><table><tr><th></th><th>this work</th><th></th></tr>{''.join(lines)}</table>{note}"


def _provenance(stack: MicrographStack | None, rec: Reconstruction, scores: Scores | None) -> str:
    """Return the provenance of all inputs, folded."""
    parts: dict[str, Any] = {"reconstruction": dict(rec.provenance)}
    for name in ("gain", "offset"):
        value = getattr(rec, name)
        if value is not None:
            parts[name] = dict(zip(rec.instrument.detector_names, value.tolist(), strict=True))
    parts["instrument"] = rec.instrument.model_dump(mode="json", exclude_none=True)
    if stack is not None:
        parts["micrographs"] = dict(stack.provenance)
    if scores is not None:
        parts["scores"] = scores.as_dict()
    out = ["<h2>Provenance</h2>"]
    for name, value in parts.items():
        text = html.escape(json.dumps(value, indent=2, default=str, ensure_ascii=False))
        out.append(f"<details><summary>{name}</summary><pre>{text}</pre></details>")
    return "".join(out)


def _sections(
    stack: MicrographStack | None, rec: Reconstruction, truth: Truth | None
) -> tuple[list[str], dict[str, str]]:
    """Return the HTML of all figure sections, and the figures' JSON by the id of their element."""
    out: list[str] = []
    figures: dict[str, str] = {}
    for group in report_groups(stack, rec, truth):
        places = []
        for figure in group.figures:
            place = f"figure-{len(figures)}"
            figures[place] = figure_json(figure)
            kind = {"mesh3d": "wide", "scatter": "half"}.get(figure["data"][0]["type"], "plot")
            places.append(f'<div id="{place}" class="{kind}"></div>')
        note = html.escape(group.note)
        out.append(f'<h2>{group.title}</h2><p>{note}</p><div class="row">{"".join(places)}</div>')
    return out, figures


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<main>
{body}
</main>
<script>{plotly}</script>
<script id="figures" type="application/json">{data}</script>
<script>{script}</script>
</body>
</html>
"""

_STYLE = """
:root { --text: #1c1e21; --quiet: #5b6168; --line: #d9dce0; --page: #ffffff; --card: #f6f7f9; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e6e8ea; --quiet: #a2a8af; --line: #3a3f45; --page: #16181b; --card: #1e2125; }
}
body { margin: 0; background: var(--page); color: var(--text); font: 16px/1.5 system-ui, sans-serif; }
main { max-width: 1240px; margin: 0 auto; padding: 24px; }
h1 { font-size: 1.6rem; margin: 0 0 4px; }
h2 { font-size: 1.15rem; margin: 36px 0 4px; border-top: 1px solid var(--line); padding-top: 16px; }
p { margin: 0 0 10px; color: var(--quiet); }
.row { display: grid; grid-template-columns: repeat(auto-fit, minmax(340px, 1fr)); gap: 12px; }
.plot { height: 380px; min-width: 0; }
.half { height: 340px; min-width: 0; }
.wide { height: 620px; min-width: 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: 8px 0; }
th, td { padding: 3px 14px 3px 0; border-bottom: 1px solid var(--line); text-align: right; }
th:first-child { text-align: left; font-weight: normal; }
td:last-child, tr:first-child th:last-child { text-align: left; color: var(--quiet); }
details { background: var(--card); border: 1px solid var(--line); border-radius: 6px; margin: 6px 0;
  padding: 6px 12px; }
summary { cursor: pointer; }
pre { overflow-x: auto; font-size: 0.82rem; }
img { max-width: 100%; background: #ffffff; border-radius: 6px; }
@media print { details { display: none; } }
"""

_SCRIPT = """
const figures = JSON.parse(document.getElementById('figures').textContent);
const scheme = window.matchMedia('(prefers-color-scheme: dark)');
function colours() {
  const css = getComputedStyle(document.documentElement);
  const text = css.getPropertyValue('--text').trim(), line = css.getPropertyValue('--line').trim();
  const change = {'font.color': text, 'font.family': 'system-ui, sans-serif', 'font.size': 12,
    'paper_bgcolor': 'rgba(0,0,0,0)', 'plot_bgcolor': 'rgba(0,0,0,0)',
    'modebar.bgcolor': 'rgba(0,0,0,0)', 'modebar.color': '#9aa0a6', 'modebar.activecolor': text};
  for (const axis of ['xaxis', 'yaxis']) {
    change[axis + '.gridcolor'] = line; change[axis + '.zerolinecolor'] = line; change[axis + '.linecolor'] = line;
  }
  return change;
}
function draw(place) {
  const figure = figures[place.id];
  const options = {responsive: true, displaylogo: false, plotlyServerURL: '',  // data stay on this machine
    showSendToCloud: false, modeBarButtonsToRemove: ['sendChartToCloud', 'sendDataToCloud']};
  Plotly.newPlot(place, figure.data, figure.layout, options).then(() => Plotly.relayout(place, colours()));
}
const places = Object.keys(figures).map(id => document.getElementById(id));
const watch = new IntersectionObserver(seen => seen.forEach(entry => {
  if (entry.isIntersecting) { watch.unobserve(entry.target); draw(entry.target); }
}), {rootMargin: '400px'});
places.forEach(place => watch.observe(place));
scheme.addEventListener('change', () => places.filter(p => p.data).forEach(p => Plotly.relayout(p, colours())));
window.addEventListener('beforeprint', () => places.filter(p => !p.data).forEach(draw));
"""
