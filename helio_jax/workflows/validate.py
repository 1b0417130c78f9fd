"""Check a scene, instrument or study file for `helio validate`, and summarise what it describes."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from helio_jax.detector import Detector
from helio_jax.errors import SceneError
from helio_jax.figures.summary import Rows, summarise
from helio_jax.instrument import Instrument
from helio_jax.scene.body import Body
from helio_jax.scene.files import read_toml
from helio_jax.scene.plates import check_solid
from helio_jax.scene.sample import MeshSample, check_body
from helio_jax.workflows.scene_file import (
    SceneFile,
    is_scene,
    is_study,
    load_instrument,
    load_scene,
    read_tables,
    replaced_lists,
)
from helio_jax.workflows.shipped import Kind, locate
from helio_jax.workflows.study_file import MAX_STUDY_MB


@dataclass(frozen=True)
class Checked:
    """A file without errors.

    Attributes:
        file: its path.
        kind: "scene", "study", or "instrument" for a file without the tables of a sample and a scan.
        instrument: beam, plate and detectors, JSON-compatible; `about`: the same, or the study, in words.
        image: pixels in x and y and number of views; none of an instrument.
        body: triangles and spheres of the sample; none of an instrument or a study.
        plate: triangles of a plate of kind "mesh".
        replaced: lists that replace those of the extended file.
        warnings: probable mistakes.
    """

    file: str
    kind: Kind
    instrument: dict[str, Any]
    about: Rows
    image: dict[str, int] | None = None
    body: dict[str, Any] | None = None
    plate: dict[str, Any] | None = None
    replaced: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()


def check_file(name: str | Path, overrides: Mapping[str, Any] | None = None) -> Checked:
    """Check a scene, its sample and the files that it names, an instrument, or the scenes of a study.

    Args:
        name: of the file, or of one that comes with the program.
        overrides: values that override the file, as in `load_scene`.

    Raises:
        SceneError: errors of the file; the message lists all of them.
        InputFileError: a file that it names is missing or wrong.
    """
    path = locate(name)
    if is_study(read_toml(path, MAX_STUDY_MB)):
        return _check_study(path, overrides)
    replaced = tuple(replaced_lists(path))
    if not is_scene(read_tables(path)):
        return Checked(str(path), "instrument", *_describe(load_instrument(path, overrides)), replaced=replaced)
    scene = load_scene(path, overrides)
    scene.read_laws()
    scene.read_rays()
    plate = scene.read_plate()
    ny, nx = scene.image_shape
    body = scene.build_body()
    from helio_jax.workflows.scene_warnings import scene_warnings  # numba: seconds that a wrong file does not need

    return Checked(
        str(path),
        "scene",
        *_describe(scene.instrument),
        image={"nx": nx, "ny": ny, "views": scene.scan.n_views},
        body=_check_sample(scene, body),
        plate=None if plate is None else check_solid(plate),
        replaced=replaced,
        warnings=(*scene.warnings(), *scene_warnings(scene, body)),
    )


def _check_study(path: Path, overrides: Mapping[str, Any] | None) -> Checked:
    """Check the scenes of all points of a study; their samples are those of scenes."""
    from helio_jax.workflows.study import point_scenes  # the tracer: seconds that a wrong file does not need

    if overrides:
        raise SceneError(f"{path}: --set {next(iter(overrides))}: a study's values stand in its tables set, case, vary")
    study, scenes = point_scenes(path)
    first = scenes[0]
    what = "heights" if study.reconstruct else "micrographs only"
    about = [*study.rows, ("points", f"{len(scenes)}, each with {what}")]
    ny, nx = first.image_shape
    image = {"nx": nx, "ny": ny, "views": first.scan.n_views}
    return Checked(str(path), "study", _describe(first.instrument)[0], about, image=image)


def _describe(instrument: Instrument) -> tuple[dict[str, Any], Rows]:
    """Describe an instrument: beam, distances [um], the direction of every detector [deg]; and in words."""
    record = {
        "incidence_deg": instrument.beam.incidence_deg,
        "azimuth_deg": instrument.beam.azimuth_deg,
        "source": instrument.beam.source,
        "plate": instrument.plate.kind,
        "working_distance_um": instrument.working_distance,
        "sample_distance_um": instrument.sample_distance,
        "detectors": [_describe_detector(d, instrument.working_distance) for d in instrument.detector],
    }
    return record, summarise(instrument)


def _describe_detector(detector: Detector, working_distance: float) -> dict[str, Any]:
    """Describe a detector: kind, polar angle and azimuth of its middle [deg], channel."""
    aim = detector.aim(working_distance)
    kind = "cone at infinity" if detector.at_infinity else "aperture" if aim else f"part {detector.part!r} of the plate"
    polar, azimuth = (None, None) if aim is None else (round(math.degrees(angle), 2) + 0.0 for angle in aim)
    return {
        "name": detector.name,
        "kind": kind,
        "polar_deg": polar,
        "azimuth_deg": azimuth,
        "channel": detector.channel,
    }


def _check_sample(scene: SceneFile, body: Body) -> dict[str, Any]:
    """Check the triangles of a scene's sample."""
    sample = scene.sample
    stands_on_flat = isinstance(sample, MeshSample) and sample.flat_size_um is not None  # which does not tilt with it
    untilted = sample.build_shape(scene.base_dir) if sample.is_tilted and not stands_on_flat else None
    return check_body(body, untilted, has_substrate=stands_on_flat)
