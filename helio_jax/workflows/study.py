"""Parameter studies: one scene with varied values, each point in its own folder.

A study file names a scene, values set for all points, named cases and varied values: all combinations (`grid`), lists
of equal length (`list`) or Sobol points in ranges (`sobol`). The folder of a point holds its scene as TOML (which
`helio run` repeats), its micrographs and optionally height map and scores; index.csv and index.json list all points,
index.png shows them. Tracing stores finished units, so a killed study loses seconds.
"""

import csv
import hashlib
import io
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from helio_jax.cpus import peak_memory_gb
from helio_jax.errors import GuardError, HelioError, InterruptedRun, ResumeError, SceneError, StoppedRun
from helio_jax.figures.sweep import save_sweep
from helio_jax.figures.wording import duration
from helio_jax.formats.safe import atomic_path, check_outputs, files_within, make_folder
from helio_jax.formats.toml import to_toml
from helio_jax.reconstruction import end_if_interrupted
from helio_jax.scene.files import read_bytes
from helio_jax.texts import parse_json
from helio_jax.workflows import pipeline
from helio_jax.workflows.checkpoint import Shard
from helio_jax.workflows.scene_file import SceneFile, files_read, load_scene, resolved, with_files
from helio_jax.workflows.shipped import locate
from helio_jax.workflows.study_file import MAX_STUDY_MB, Study, load_study
from helio_jax.workflows.study_table import averaged, chosen_scores, image_scores, possible_scores, score_label, table

INDEX_SECONDS = 5.0
"""Minimum time between two updates of the index [s]."""
WRITTEN = ("study.json", "index.json", "index.csv", "index.png", "table.md")
"""Files in a study's folder, beside those of its points."""


@dataclass(frozen=True)
class _Point:
    """One point: number from 1, what tells it from the others, folder."""

    number: int
    values: dict[str, Any]
    folder: Path

    def row(self) -> dict[str, Any] | None:
        """Return the row of the index of a finished or failed point, or None."""
        try:
            return parse_json((self.folder / "point.json").read_text(encoding="utf-8"))
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
        path: study file, or the name of one that comes with the program.
        folder: output folder of the points and the index.
        resume: continue the study in `folder`: finished points are kept, failed ones repeated.
        options: executor of the tracer; with a shard, every N-th point is run.

    Raises:
        SceneError: the study or the scene of a point is invalid (checked before any point is run).
        ResumeError: the folder holds a study and `resume` is false, or another study.
        GuardError: some points failed; the index lists the reasons.
    """
    path, folder = locate(path), Path(folder)
    study, scenes = point_scenes(path)
    inputs = [("the study", path), *files_read(locate(study.scene, path.parent), "its scene", study.set)]
    check_outputs(inputs, files_within("-o", folder, WRITTEN))
    points = [_Point(i, v, folder / f"point_{i:05d}") for i, v in enumerate(study.points(), start=1)]
    texts = list(map(_scene_text, scenes))
    _begin(folder, path, texts, is_shared=resume or options.shard is not None)
    shard = Shard.parse(options.shard) if options.shard else Shard(1, 1)
    options = replace(options, shard=None)
    mine = list(zip(points, texts, strict=True))[shard.number - 1 :: shard.of]
    todo = [(point, text) for point, text in mine if (row := point.row()) is None or row["status"] == "failed"]
    start, written = time.monotonic(), -math.inf
    for i, (point, text) in enumerate(todo):
        left = f"{len(mine) - len(todo) + i} done, {len(todo) - i} left"
        if i:
            each = (time.monotonic() - start) / i
            memory = peak_memory_gb()
            left += f", about {duration(each * (len(todo) - i))}" + (f"; {memory:.1f} GB of memory" if memory else "")
        options.say(f"point {point.number} of {len(points)} ({left}): {_short(point.values)}")
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
        path = Path(parse_json(read_bytes(manifest, MAX_STUDY_MB, SceneError))["study"])
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
        then = dict(parse_json(read_bytes(manifest, MAX_STUDY_MB, SceneError)))
    except (ValueError, TypeError):
        raise ResumeError(f"{manifest} is damaged: remove it, and repeat the study command with --resume") from None
    if then.get("scenes") != now["scenes"]:
        raise ResumeError(
            f"{folder} holds another study, or {path} or its scene has changed since: choose another folder"
        )


def point_scenes(path: Path) -> tuple[Study, list[SceneFile]]:
    """Load a study and the scenes of all of its points.

    Raises:
        SceneError: the study or the scene of a point is invalid, or the index will have no column that it asks for.
    """
    study = load_study(path)
    scene_path, scenes = locate(study.scene, path.parent), []
    for number, point in enumerate(study.points(), start=1):
        try:
            scenes.append(load_scene(scene_path, study.overrides(point)))
        except SceneError as e:
            raise SceneError(f"{path}: point {number}: {e}") from None
    first = scenes[0]
    possible = possible_scores(study.reconstruct, first.instrument.detector_names, first.scan.n_views)
    for pattern in [study.score] if isinstance(study.score, str) else study.score or []:
        if not chosen_scores(pattern, possible):
            raise SceneError(f"{path}: score must be among {', '.join(possible)} (* for any text), got {pattern!r}")
    return study, scenes


def _scene_text(scene: SceneFile) -> str:
    """Return the scene of a point as TOML, with absolute file names."""
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
            end_if_interrupted(result.status)  # resumed, the study runs this point again
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


def _write_index(study: Study, folder: Path, points: list[_Point], *, is_last: bool = False) -> Path:
    """Write index.json, index.csv and, if `is_last`, table and figure; return the path of index.csv."""
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
    if is_last:
        _write_summary(study, folder, rows)
        if failed := [row for row in rows if row["status"] == "failed"]:
            first = f"the first, point {failed[0]['point']}: {failed[0]['problem']}"
            raise GuardError(f"{len(failed)} of {len(rows)} points failed ({folder / 'index.csv'}); {first}")
    return folder / "index.csv"


def _write_summary(study: Study, folder: Path, rows: list[dict[str, Any]]) -> None:
    """Write the table and the figure of what is done."""
    scores = chosen_scores(study.score, list(dict.fromkeys(key for row in rows for key in row)))
    keys = (["case"] if study.case else []) + list(study.vary)
    labels = {key: study.label.get(key, key) for key in keys}
    points = averaged(rows, keys, scores)
    if not scores or not points:
        return
    with atomic_path(folder / "table.md") as part:
        part.write_text(table(points, labels, scores), encoding="utf-8")
    save_sweep(points, labels, {score: score_label(score) for score in scores}, study.name, folder / "index.png")


def _short(values: dict[str, Any]) -> str:
    return ", ".join(
        f"{key} = {value:g}" if isinstance(value, float) else f"{key} = {value}" for key, value in values.items()
    )
