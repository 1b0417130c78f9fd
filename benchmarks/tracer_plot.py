"""Draw the table of `tracer.py`: rays per second against the number of triangles, and the bounce loop over Embree."""

import json
from pathlib import Path

from matplotlib.figure import Figure

REFERENCE = 3.6e3, 8.6e3
"""Triangles, and rays per second there, of the reference program, which falls as 1 / N."""


def draw(table: Path, path: Path) -> None:
    """Draw rows 8 and 12 of a table of results (JSON) into a picture; the machine is named in its title."""
    found = json.loads(table.read_text())
    sizes = [(r["triangles"], r["rays_per_second"]) for r in found["rows"] if r["row"] == "12"]
    ratios = [(r["triangles"], r["ratio"]) for r in found["rows"] if r["row"] == "8"]
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    figure.suptitle(f"{found['machine']['processor']}, one thread", fontsize=9)
    if sizes:
        n = [s for s, _ in sizes]
        left.loglog(*zip(*sizes, strict=True), "o-", label="helio_jax, analog")
        left.loglog(n, [REFERENCE[1] * REFERENCE[0] / s for s in n], "--", label="reference program, 1/N")
        left.set(xlabel="triangles", ylabel="beam rays per second")
        left.legend()
    if ratios:
        right.semilogx(*zip(*ratios, strict=True), "s-")
        right.axhline(1.4, ls=":", color="gray")
        right.set(xlabel="triangles", ylabel="bounce loop / bare embreex", ylim=(1.0, 1.8))
    for ax in (left, right):
        ax.grid(alpha=0.3, which="both")
    figure.savefig(path, dpi=110)
    print(f"drawn {path}")
