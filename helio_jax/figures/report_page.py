"""Template, style and script of the HTML report.

The script draws each figure when it is scrolled to, in the colours of the reader's light or dark scheme, and all of
them before printing. It loads nothing.
"""

PAGE = """<!DOCTYPE html>
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

STYLE = """
:root { --text: #1c1e21; --quiet: #565c63; --line: #d9dce0; --page: #ffffff; --card: #f6f7f9; --link: #1f5fa8;
  --good: #1a6b3a; --care: #8a5a00; --bad: #b00020; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e6e8ea; --quiet: #a9afb6; --line: #3a3f45; --page: #16181b; --card: #1e2125; --link: #8ab8ee;
    --good: #6fcf97; --care: #f0b84a; --bad: #ff8a80; }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--page); color: var(--text); font: 16px/1.5 system-ui, sans-serif; }
main { max-width: 1240px; margin: 0 auto; padding: 24px; }
h1 { font-size: 1.6rem; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 36px 0 4px; border-top: 1px solid var(--line); padding-top: 16px; }
p, ul { margin: 0 0 10px; color: var(--quiet); overflow-wrap: anywhere; }
a { color: var(--link); }
nav { font-size: 0.9rem; margin: 12px 0; line-height: 1.9; }
nav a { margin-right: 14px; }
.verdict { font-size: 1.1rem; font-weight: 600; border-left: 5px solid currentColor; padding-left: 10px; }
.good { color: var(--good); } .care { color: var(--care); } .bad { color: var(--bad); }
.row { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(340px, 100%), 1fr)); gap: 12px; }
figure { margin: 0; min-width: 0; }
.plot { height: 380px; } .half { height: 360px; } .wide { height: 620px; grid-column: 1 / -1; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: 8px 0; }
th, td { padding: 3px 14px 3px 0; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top; }
th { font-weight: normal; color: var(--quiet); white-space: nowrap; }
td { overflow-wrap: break-word; min-width: 3.5em; }
.number { text-align: right; overflow-wrap: normal; white-space: nowrap; }
details { background: var(--card); border: 1px solid var(--line); border-radius: 6px; margin: 6px 0;
  padding: 6px 12px; }
summary { cursor: pointer; }
pre { overflow-x: auto; font-size: 0.82rem; }
img { min-width: 560px; max-width: 100%; height: auto; background: #ffffff; border-radius: 6px; }
@media (max-width: 600px) { main { padding: 14px; } .wide { height: 420px; } th { white-space: normal; } }
@media print { details, nav { display: none; } }
"""

SCRIPT = """
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
