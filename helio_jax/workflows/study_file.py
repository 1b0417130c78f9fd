"""The study file: a scene, values set for all points, named cases and varied values. Running it: study.py."""

import itertools
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from helio_jax.errors import SceneError
from helio_jax.scene.files import read_toml
from helio_jax.settings import Settings
from helio_jax.workflows.scene_errors import explain_errors

MAX_POINTS = 100_000
MAX_KEYS = 1000
"""Largest number of values that are set, and of those that are varied."""
MAX_STUDY_MB = 4.0
"""Largest study file."""


class Range(Settings):
    """A range of numbers."""

    low: float
    """Smallest value."""
    high: float
    """Largest value."""
    n: int | None = Field(default=None, ge=2, le=MAX_POINTS)
    """`grid`, `list`: number of equally spaced values."""
    log: bool = False
    """Spaced equally in the logarithm."""
    whole: bool = False
    """Rounded to whole numbers."""

    @model_validator(mode="after")
    def _is_range(self) -> "Range":
        if not self.low < self.high or (self.log and self.low <= 0):
            limit = "0 < low < high with log" if self.log else "low < high"
            raise ValueError(f"a range needs {limit}, got low = {self.low:g}, high = {self.high:g}")
        return self

    def at(self, shares: np.ndarray) -> list[float | int]:
        """Return the values at fractions `shares` (0 to 1) of the range."""
        ends = np.log([self.low, self.high]) if self.log else np.array([self.low, self.high])
        found = ends[0] + shares * (ends[1] - ends[0])
        found = np.clip(np.exp(found) if self.log else found, self.low, self.high)
        return [round(v) if self.whole else float(v) for v in found]


class Study(Settings):
    """A study file."""

    scene: str = Field(min_length=1, max_length=4096)
    """Scene file, relative to the study file."""
    name: str = Field(default="study", min_length=1, max_length=200)
    """Title of the figure."""
    design: Literal["grid", "list", "sobol"] = "grid"
    """`grid`: all combinations; `list`: the i-th values together; `sobol`: scrambled Sobol points in the ranges."""
    n_points: int | None = Field(default=None, ge=1, le=MAX_POINTS)
    """`sobol`: number of points."""
    seed: int = Field(default=1, ge=0, lt=2**63)
    """`sobol`: seed of the scrambling (the tracer's seed is "trace.seed")."""
    reconstruct: bool = True
    """Reconstruct and score the heights, too; false: micrographs only."""
    report: bool = False
    """Write an HTML report for each point, too."""
    score: str | list[str] | None = None
    """Columns of the index to plot and print; default: the RMS error, or the share of multiple scattering."""
    label: dict[str, str] = Field(default={}, max_length=MAX_KEYS)
    """Names of varied keys for people, e.g. "sample.spheres.0.cap_height_um" = "height of the cap [um]"."""
    repeat: int = Field(default=1, ge=1, le=1000)
    """Runs of each point; with more than one, the i-th has "trace.seed" = "noise.seed" = i, and the figure shows mean
    and standard deviation."""
    set: dict[str, Any] = Field(default={}, max_length=MAX_KEYS)
    """Values for all points, by dotted key, e.g. "trace.rays" = 32."""
    case: dict[str, dict[str, Any]] = Field(default={}, max_length=MAX_KEYS)
    """Named sets of values, each of which is run with all that is varied, e.g. [case.linear] "reconstruct.method" =
    "linear"; the index has their names in the column `case`."""
    vary: dict[str, list[Any] | Range] = Field(default={}, max_length=MAX_KEYS)
    """Values or ranges, by dotted key, e.g. "sample.spheres.0.cap_height_um" = [100.0, 400.0]."""

    @model_validator(mode="after")
    def _fits_design(self) -> "Study":
        problems = [] if self.vary or self.case else ["vary: is empty, and so is case: name what changes"]
        for key, values in self.vary.items():
            is_range = isinstance(values, Range)
            if self.design == "sobol" and not is_range:
                problems.append(f'vary: "{key}" must be a range for design "sobol", e.g. {{ low = 1.0, high = 2.0 }}')
            if self.design != "sobol" and is_range and values.n is None:
                problems.append(f'vary: "{key}" needs n, the number of values, for design "{self.design}"')
            if not is_range and not values:
                problems.append(f'vary: "{key}" must have at least one value, got []')
        if self.design == "sobol" and self.n_points is None:
            problems.append('n_points: is missing, design "sobol" needs it')
        if self.design == "sobol" and not self.vary:
            problems.append('vary: is empty, design "sobol" needs ranges')
        if not problems and (n := self._n_varied() * max(len(self.case), 1) * self.repeat) > MAX_POINTS:
            problems.append(f"vary, case and repeat: give {n} points, the limit is {MAX_POINTS}: vary less")
        if not problems and self.design == "list" and len({len(v) for v in self._lists()}) > 1:
            counts = ", ".join(f'"{k}" {len(v)}' for k, v in zip(self.vary, self._lists(), strict=True))
            problems.append(f'vary: design "list" needs as many values of each, got {counts}')
        if problems:
            raise ValueError("\n".join(problems))
        return self

    def _lists(self) -> list[list[Any]]:
        return [v.at(np.linspace(0, 1, v.n)) if isinstance(v, Range) else v for v in self.vary.values()]  # type: ignore[arg-type]

    def _n_varied(self) -> int:
        sizes = [v.n if isinstance(v, Range) else len(v) for v in self.vary.values()]
        if self.design == "sobol":
            return self.n_points or 0
        return math.prod(n or 0 for n in sizes) if self.design == "grid" or not sizes else sizes[0] or 0

    def points(self) -> list[dict[str, Any]]:
        """Return what tells each point from the others: its case, its varied values by dotted key, its repetition."""
        points = [{"case": name} | values for name in self.case for values in self._varied()]
        points = points if self.case else self._varied()
        if self.repeat == 1:
            return points
        return [point | {"repeat": i} for point in points for i in range(1, self.repeat + 1)]

    @property
    def rows(self) -> list[tuple[str, str]]:
        """What it varies, in words."""
        cases = [f"cases: {', '.join(self.case)}"] if self.case else []
        return [("study", self.name), ("scene", self.scene), ("varies", ", ".join([*self.vary, *cases]))]

    def overrides(self, point: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of the scene at a point, by dotted key: varied ones win over its case, that over `set`."""
        varied = {key: point[key] for key in self.vary}
        seeds = dict.fromkeys(("trace.seed", "noise.seed"), point["repeat"]) if "repeat" in point else {}
        return self.set | self.case.get(point.get("case", ""), {}) | seeds | varied

    def _varied(self) -> list[dict[str, Any]]:
        """Return the varied values of each point, by dotted key."""
        if self.design == "sobol":
            from scipy.stats import qmc  # takes half a second to import

            n = self._n_varied()
            unit = qmc.Sobol(len(self.vary), scramble=True, rng=self.seed).random_base2((n - 1).bit_length())[:n]
            columns = [v.at(unit[:, i]) for i, v in enumerate(self.vary.values()) if isinstance(v, Range)]
            rows: Any = zip(*columns, strict=True)
        elif self.design == "grid" or not self.vary:
            rows = itertools.product(*self._lists())
        else:
            rows = zip(*self._lists(), strict=True)
        return [dict(zip(self.vary, row, strict=True)) for row in rows]


def load_study(path: Path) -> Study:
    """Read a study file.

    Raises:
        SceneError: missing, not TOML, or invalid; the message lists all errors.
    """
    data = read_toml(path, MAX_STUDY_MB)
    for table in ("set", "vary", "label"):
        if isinstance(data.get(table), Mapping):
            data[table] = dict(_flat(data[table]))
    if isinstance(data.get("case"), Mapping):
        tables = data["case"].items()
        data["case"] = {name: dict(_flat(t)) if isinstance(t, Mapping) else t for name, t in tables}
    try:
        return Study.model_validate(data)
    except ValidationError as e:
        raise SceneError(explain_errors(str(path), e, Study, data)) from None


def _flat(table: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted keys and values of a table whose keys are quoted ("trace.rays") or nested (trace.rays)."""
    for key, value in table.items():
        if isinstance(value, Mapping) and not set(value) <= set(Range.model_fields):
            yield from _flat(value, f"{above}{key}.")
        else:
            yield f"{above}{key}", value
