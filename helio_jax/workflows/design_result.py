"""Layouts that a design has found: records, ranking, files."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.figures.canvas import save_figure
from helio_jax.figures.design import Point, save_pareto
from helio_jax.figures.instrument_page import draw_instrument
from helio_jax.formats.safe import atomic_path
from helio_jax.formats.toml import write_calibrated
from helio_jax.instrument import Instrument

MASKED = 0.01
"""Masked share above which the expected gain of a layout is not to be relied on: on traced mesas, of which the B-SHeM's
layout masks 4 to 7 %, layouts that promised a quarter of the variance had 0.3 to 20 times it (docs/design.md)."""
SAME = 3e-3
"""Layouts of one number of apertures whose results differ by less than this share are one."""


@dataclass(frozen=True)
class Proposal:
    """One layout and what it reaches on the samples.

    Attributes:
        instrument: with this layout, at the scene's distance from nominal spot to substrate.
        kind: "scene": that of the scene; "free": no aperture is tied to another; "pairs": symmetric about the beam.
        masked_weight: of the search that found it.
        status: how that search ended.
        height_std_um: root of the mean variance of the heights, geometric mean over the samples [um].
        variance_ratio: variance over that of the scene's layout, geometric mean over the samples.
        variance_ratios: the same of each sample.
        masked: masked share of the apertures, mean over detectors, pixels and samples.
        masked_ratio: over that of the scene's layout; None where that masks nothing.
        count_ratio: counts of all apertures together over those of the scene's layout.
        least_wall_um: thinnest wall between apertures, pinhole disc and plate's edge [um].
        is_best: whether no other layout is better in one of height, masked area and counts, and as good in the others.
    """

    instrument: Instrument
    kind: str
    masked_weight: float
    status: str
    height_std_um: float
    variance_ratio: float
    variance_ratios: tuple[float, ...]
    masked: float
    masked_ratio: float | None
    count_ratio: float
    least_wall_um: float
    is_best: bool = False

    @property
    def n_apertures(self) -> int:
        """Number of apertures."""
        return len(self.instrument.detector)

    @property
    def angles_deg(self) -> tuple[tuple[float, float], ...]:
        """Polar angle and azimuth of each aperture's centre [deg]."""
        aims = (d.aim(self.instrument.working_distance) or (0.0, 0.0) for d in self.instrument.detector)
        return tuple((math.degrees(polar), math.degrees(azimuth)) for polar, azimuth in aims)

    @property
    def label(self) -> str:
        """Name in tables and pictures."""
        if self.kind == "scene":
            return "the scene's"
        return f"{self.n_apertures} {self.kind}"

    def as_dict(self) -> dict[str, Any]:
        """Make a JSON-compatible record."""
        own = {key: value for key, value in vars(self).items() if key != "instrument"}
        return {**own, "n_apertures": self.n_apertures, "instrument": self.instrument.model_dump(mode="json")}


@dataclass(frozen=True)
class Design:
    """Layouts, ranked.

    Attributes:
        name: of the scene.
        samples: names of the scenes whose samples count.
        reference: the scene's layout.
        proposals: kept layouts, by `height_std_um`.
        found: every layout that a search ended at, kept or not.
        total_area_um2: of all apertures of each layout [um^2].
    """

    name: str
    samples: tuple[str, ...]
    reference: Proposal
    proposals: tuple[Proposal, ...]
    found: tuple[Proposal, ...]
    total_area_um2: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to know before a layout is relied on."""
        if self.reference.masked <= MASKED:
            return ()
        return (
            f"the samples mask {self.reference.masked:.1%} of the scene's apertures (limit {MASKED:.0%}): expected "
            "variances take the walls for known, and traced samples did not confirm them: simulate and reconstruct "
            "with a layout before it is made",
        )

    def as_dict(self) -> dict[str, Any]:
        """Make a JSON-compatible record."""
        return {
            "name": self.name,
            "warnings": list(self.warnings),
            "samples": list(self.samples),
            "total_area_um2": self.total_area_um2,
            "reference": self.reference.as_dict(),
            "proposals": [p.as_dict() for p in self.proposals],
        }

    def write(self, folder: str | Path) -> list[Path]:
        """Write design.json, pareto.png and for each kept layout an instrument file and a drawing; return the files."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        files = [folder / "design.json", folder / "pareto.png"]
        with atomic_path(files[0]) as part:
            part.write_text(json.dumps(self.as_dict(), indent=1) + "\n", encoding="utf-8")
        points = [_point(p, str(i)) for i, p in enumerate(self.proposals, 1)]
        rest = [_point(p, "") for p in self.found if p not in self.proposals]
        save_pareto([*rest, *points, _point(self.reference, "scene")], f"{self.name}: design", files[1])
        for i, proposal in enumerate(self.proposals, 1):
            drawn, kept = folder / f"layout_{i}.png", folder / f"layout_{i}.toml"
            save_figure(draw_instrument(proposal.instrument), drawn)
            write_calibrated(_for_file(proposal.instrument), kept, _comment(self, proposal))
            files += [kept, drawn]
        return files


def _point(p: Proposal, label: str) -> Point:
    return Point(label, p.height_std_um, 100.0 * p.masked, p.count_ratio, p.n_apertures)


def _for_file(instrument: Instrument) -> Instrument:
    """Return the instrument without the sample distance, which belongs to the scene."""
    return instrument.model_copy(update={"plate": instrument.plate.model_copy(update={"sample_distance_um": None})})


def _comment(found: Design, p: Proposal) -> str:
    masked = "" if p.masked_ratio is None else f", masked area {p.masked_ratio:.2f} times"
    return (
        f"Layout of {p.n_apertures} apertures by helio design for {found.name} (samples: {', '.join(found.samples)}).\n"
        f"Expected against the scene's layout: variance of the heights {p.variance_ratio:.2f} times{masked},\n"
        f"counts {p.count_ratio:.2f} times; all apertures together {found.total_area_um2:.6g} um^2."
    )


def _scores(p: Proposal) -> np.ndarray:
    """Return what is better if smaller."""
    return np.array([p.height_std_um, p.masked, -p.count_ratio])


def distinct(found: Sequence[Proposal]) -> list[Proposal]:
    """Return layouts by `height_std_um`, without those that equal a better one in number, incidence and results."""
    out: list[Proposal] = []
    for p in sorted(found, key=lambda p: (p.height_std_um, p.masked)):
        alike = (q for q in out if (q.n_apertures, q.instrument.beam) == (p.n_apertures, p.instrument.beam))
        if not any(np.all(abs(_scores(p) - _scores(q)) <= SAME * abs(_scores(q))) for q in alike):
            out.append(p)
    return out


def with_best(found: Sequence[Proposal]) -> list[Proposal]:
    """Mark the layouts that no other one dominates."""

    def is_dominated(p: Proposal) -> bool:
        return any(np.all(_scores(q) <= _scores(p)) and np.any(_scores(q) < _scores(p)) for q in found)

    return [replace(p, is_best=not is_dominated(p)) for p in found]


def kept(found: Sequence[Proposal], most: int) -> tuple[Proposal, ...]:
    """Keep the layouts that none dominates, the best of each number first; by `height_std_um`."""
    first = {p.n_apertures: p for p in reversed(found)}
    order = sorted(found, key=lambda p: (p is not first[p.n_apertures], not p.is_best, p.height_std_um))
    return tuple(sorted(order[:most], key=lambda p: p.height_std_um))
