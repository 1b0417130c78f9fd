"""Parameter studies: one scene with varied values, each point in its own folder.

A study file names a scene, values set for all points, and varied values: all combinations (`grid`), lists of equal
length (`list`) or Sobol points in ranges (`sobol`). The folder of a point holds its scene as TOML (which `helio run`
repeats), its micrographs and optionally height map and scores; index.csv and index.json list all points. Tracing stores
finished units, so a killed study loses seconds.
"""

import csv
import hashlib
import io
import itertools
import json
import math
import time
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator
from scipy.stats import qmc

from helio_jax.errors import GuardError, HelioError, InterruptedRun, ResumeError, SceneError, StoppedRun
from helio_jax.figures.sweep import save_sweep
from helio_jax.formats.safe import atomic_path, check_outputs, files_within, make_folder
from helio_jax.formats.toml import to_toml
from helio_jax.micrograph import MicrographStack
from helio_jax.scene.files import read_bytes
from helio_jax.settings import Settings
from helio_jax.workflows import pipeline
from helio_jax.workflows.checkpoint import Shard
from helio_jax.workflows.scene_errors import explain_errors
from helio_jax.workflows.scene_file import files_read, load_scene, resolved, with_files
from helio_jax.workflows.shipped import locate

MAX_POINTS = 100_000
INDEX_SECONDS = 5.0
"""Minimum time between two updates of the index [s]."""
MAX_STUDY_MB = 4.0
WRITTEN = ("study.json", "index.json", "index.csv", "index.png")
"""Files in a study's folder, beside those of its points."""


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
    """Title of the plot."""
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
    score: str | None = None
    """Column of the index to plot; default: the RMS error, or the share of multiple scattering."""
    set: dict[str, Any] = {}
    """Values for all points, by dotted key, e.g. "trace.rays" = 32."""
    vary: dict[str, list[Any] | Range] = Field(min_length=1)
    """Values or ranges, by dotted key, e.g. "sample.spheres.0.cap_height_um" = [100.0, 400.0]."""

    @model_validator(mode="after")
    def _fits_design(self) -> "Study":
        problems = []
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
        if not problems and (n := self._n_points()) > MAX_POINTS:
            problems.append(f"vary: gives {n} points, the limit is {MAX_POINTS}: vary less")
        if not problems and self.design == "list" and len({len(v) for v in self._lists()}) > 1:
            counts = ", ".join(f'"{k}" {len(v)}' for k, v in zip(self.vary, self._lists(), strict=True))
            problems.append(f'vary: design "list" needs as many values of each, got {counts}')
        if problems:
            raise ValueError("\n".join(problems))
        return self

    def _lists(self) -> list[list[Any]]:
        return [v.at(np.linspace(0, 1, v.n)) if isinstance(v, Range) else v for v in self.vary.values()]  # type: ignore[arg-type]

    def _n_points(self) -> int:
        sizes = [v.n if isinstance(v, Range) else len(v) for v in self.vary.values()]
        if self.design == "sobol":
            return self.n_points or 0
        return math.prod(n or 0 for n in sizes) if self.design == "grid" else sizes[0] or 0

    def points(self) -> list[dict[str, Any]]:
        """Return the varied values of each point, by dotted key."""
        if self.design == "sobol":
            n = self._n_points()
            unit = qmc.Sobol(len(self.vary), scramble=True, rng=self.seed).random_base2((n - 1).bit_length())[:n]
            columns = [v.at(unit[:, i]) for i, v in enumerate(self.vary.values()) if isinstance(v, Range)]
            rows: Any = zip(*columns, strict=True)
        else:
            rows = itertools.product(*self._lists()) if self.design == "grid" else zip(*self._lists(), strict=True)
        return [dict(zip(self.vary, row, strict=True)) for row in rows]


def load_study(path: Path) -> Study:
    """Read a study file.

    Raises:
        SceneError: missing, not TOML, or invalid; the message lists all errors.
    """
    try:
        data = tomllib.loads(read_bytes(path, MAX_STUDY_MB, SceneError).decode("utf-8-sig"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as e:
        raise SceneError(f"{path}: is not valid TOML: {e}") from None
    for table in ("set", "vary"):
        if isinstance(data.get(table), Mapping):
            data[table] = dict(_flat(data[table]))
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


@dataclass(frozen=True)
class _Point:
    """One point: number from 1, varied values, folder."""

    number: int
    values: dict[str, Any]
    folder: Path

    def row(self) -> dict[str, Any] | None:
        """Return the row of the index of a finished or failed point, or None."""
        try:
            return json.loads((self.folder / "point.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None


def run_study(
    path: str | Path,
    folder: str | Path,
    *,
    resume: bool = False,
    options: pipeline.SimulateOptions = pipeline.SimulateOptions(),
) -> Path:
    """Run a study; return the path of index.csv.

    Args:
        path: study file.
        folder: output folder of the points and the index.
        resume: continue the study in `folder`: finished points are kept, failed ones repeated.
        options: executor of the tracer; with a shard, every N-th point is run.

    Raises:
        SceneError: the study or the scene of a point is invalid (checked before any point is run).
        ResumeError: the folder holds a study and `resume` is false, or another study.
        GuardError: some points failed; the index lists the reasons.
    """
    path, folder = Path(path), Path(folder)
    study = load_study(path)
    points = [_Point(i, v, folder / f"point_{i:05d}") for i, v in enumerate(study.points(), start=1)]
    scene_path = locate(study.scene, path.parent)
    inputs = [("the study", path), *files_read(scene_path, "its scene", study.set)]
    check_outputs(inputs, files_within("-o", folder, WRITTEN))
    scenes = [_scene_text(scene_path, study.set | p.values, f"{path}: point {p.number}") for p in points]
    _begin(folder, path, scenes, is_shared=resume or options.shard is not None)
    shard = Shard.parse(options.shard) if options.shard else Shard(1, 1)
    options = replace(options, shard=None)
    written = -math.inf
    for point, text in list(zip(points, scenes, strict=True))[shard.number - 1 :: shard.of]:
        row = point.row()
        if row is None or row["status"] == "failed":
            options.say(f"point {point.number} of {len(points)}: {_short(point.values)}")
            _run_point(study, point, text, options)
            if time.monotonic() - written > INDEX_SECONDS:
                _write_index(study, folder, points)
                written = time.monotonic()
    return _write_index(study, folder, points, is_last=True)


def resume_study(folder: Path, *, say: Callable[[str], None] = print) -> Path:
    """Resume the study of a folder; return the path of index.csv.

    Raises:
        ResumeError: the study file is missing or has changed.
    """
    manifest = folder / "study.json"
    try:
        path = Path(json.loads(read_bytes(manifest, MAX_STUDY_MB, SceneError))["study"])
    except (KeyError, TypeError, ValueError) as e:
        raise ResumeError(f"{manifest} is damaged ({e!r}): repeat the study command with --resume") from None
    if not path.is_file():
        raise ResumeError(f"the study {path} of {folder} is missing: restore it, or choose another folder")
    return run_study(path, folder, resume=True, options=pipeline.SimulateOptions(say=say))


def _begin(folder: Path, path: Path, scenes: list[str], is_shared: bool) -> None:
    """Make the folder, or check that it holds this study."""
    make_folder(folder)
    manifest = folder / "study.json"
    now = {"study": str(path.resolve()), "scenes": hashlib.sha256("\n".join(scenes).encode()).hexdigest()}
    if not manifest.exists():
        with atomic_path(manifest) as part:
            part.write_text(json.dumps(now) + "\n", encoding="utf-8")
        return
    if not is_shared:
        raise ResumeError(f"{folder} holds a study already: continue it with --resume, or set another folder with -o")
    try:
        then = dict(json.loads(read_bytes(manifest, MAX_STUDY_MB, SceneError)))
    except (ValueError, TypeError):
        raise ResumeError(f"{manifest} is damaged: remove it, and repeat the study command with --resume") from None
    if then.get("scenes") != now["scenes"]:
        raise ResumeError(
            f"{folder} holds another study, or {path} or its scene has changed since: choose another folder"
        )


def _scene_text(path: Path, overrides: dict[str, Any], place: str) -> str:
    """Return the scene of a point as TOML, with absolute file names."""
    try:
        scene = load_scene(path, overrides)
    except SceneError as e:
        raise SceneError(f"{place}: {e}") from None
    # values that [reconstruct] does not set stay unset: a calibration may set them
    tables = resolved(scene) | {"reconstruct": scene.reconstruct.model_dump(mode="json", exclude_unset=True)}
    return to_toml(with_files(tables, lambda name: str((scene.base_dir / name).resolve())))


def _run_point(study: Study, point: _Point, text: str, options: pipeline.SimulateOptions) -> None:
    """Run one point; a failure is recorded, not raised."""
    point.folder.mkdir(exist_ok=True)
    scene = point.folder / "scene.toml"
    if not scene.exists():
        with atomic_path(scene) as part:
            part.write_text(text, encoding="utf-8")
    row: dict[str, Any] = {"point": point.number, **point.values, "status": "done", "problem": ""}
    try:
        if study.reconstruct:
            result = pipeline.run(scene, point.folder, executor=options.executor, say=options.say, report=study.report)
            row |= {"method": result.method, **result.scores.as_dict()}
        else:
            stack = pipeline.simulate_file(scene, point.folder / "micrographs.h5", options=options)
            stacks = stack.stacks if stack else ()
            for i, one in enumerate(stacks, start=1):
                view = f"_view{i}" if len(stacks) > 1 else ""
                row |= {f"{key}{view}": value for key, value in image_scores(one).items()}
    except HelioError as e:
        if isinstance(e, (StoppedRun, InterruptedRun)):
            how = f"`helio resume {point.folder.parent}` resumes the study"
            raise type(e)(f"stopped in point {point.number}, whose finished units are kept: {how}") from e
        row |= {"status": "failed", "problem": str(e)}
    with atomic_path(point.folder / "point.json") as part:
        part.write_text(json.dumps(row) + "\n", encoding="utf-8")


def image_scores(stack: MicrographStack) -> dict[str, float]:
    """Compute mean counts, contrast (std_dev / mean) and share of multiple scattering of each micrograph."""
    out: dict[str, float] = {}
    multiple = stack.multiple
    for k, name in enumerate(stack.instrument.detector_names):
        mean = float(stack.counts[k].mean())
        out[f"mean_{name}"] = mean
        out[f"contrast_{name}"] = float(stack.counts[k].std()) / mean if mean else 0.0
        if multiple is not None:
            out[f"multiple_{name}"] = float(multiple[k].mean()) / mean if mean else 0.0
    return out


def _write_index(study: Study, folder: Path, points: list[_Point], *, is_last: bool = False) -> Path:
    """Write index.json, index.csv and, if `is_last`, the plot; return the path of index.csv."""
    blank = {"status": "not run", "problem": ""}
    rows = [p.row() or {"point": p.number, **p.values, **blank} for p in points]
    columns = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    for name, content in (("index.json", json.dumps(rows, indent=1) + "\n"), ("index.csv", text.getvalue())):
        with atomic_path(folder / name) as part:
            part.write_text(content, encoding="utf-8")
    failed = [row for row in rows if row["status"] == "failed"]
    if is_last:
        if study.score and study.score not in columns:
            raise SceneError(f"{study.name}: score must be one of {', '.join(columns)}, got {study.score!r}")
        score = study.score or next(
            (c for c in columns if c.startswith(("rms_region", "rms_image", "multiple_"))), None
        )
        if score:
            save_sweep(rows, list(study.vary), score, study.name, folder / "index.png")
        if failed:
            first = f"the first, point {failed[0]['point']}: {failed[0]['problem']}"
            raise GuardError(f"{len(failed)} of {len(rows)} points failed ({folder / 'index.csv'}); {first}")
    return folder / "index.csv"


def _short(values: dict[str, Any]) -> str:
    return ", ".join(
        f"{key} = {value:g}" if isinstance(value, float) else f"{key} = {value}" for key, value in values.items()
    )
