"""Repeat what made a file: simulate its scene again, and reconstruct it with its settings. `helio rerun`."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from helio_jax.errors import InputFileError
from helio_jax.formats.hdf5 import read
from helio_jax.formats.history import history_of
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.reconstruction import Reconstruction, end_if_interrupted
from helio_jax.workflows import pipeline
from helio_jax.workflows.provenance import with_provenance
from helio_jax.workflows.scene_errors import explain_errors
from helio_jax.workflows.truth import simulated_scene


@dataclass(frozen=True)
class Rerun:
    """A repetition, and how it compares with the file.

    Attributes:
        found: the repeated micrographs or heights.
        what: "counts" or "height".
        is_equal: bit for bit.
        largest: largest difference, in counts or um.
        version: of the program that made the file.
    """

    found: MicrographStack | MicrographSet | Reconstruction
    what: str
    is_equal: bool
    largest: float
    version: str

    def as_dict(self) -> dict[str, Any]:
        """Return the comparison."""
        return {"what": self.what, "is_equal": self.is_equal, "largest": self.largest, "version": self.version}


def rerun(path: str | Path, report: Callable[[str], None] = lambda text: None) -> Rerun:
    """Repeat the simulation, and the reconstruction if there was one, that made a file.

    Files that the scene names (meshes, height maps) are sought where it names them, relative ones beside `path`.

    Args:
        path: micrographs or heights (.h5) of a simulated scene.
        report: called with each step.

    Raises:
        InputFileError: the file is not of simulated data, or this version does not accept its scene or settings.
    """
    before = read(path)
    history = history_of(before, str(path))
    scene = simulated_scene(before, Path(path))
    report("tracing")
    found: Any = pipeline.simulate(scene)
    if history.is_noisy:
        found = pipeline.record(scene, found)
    found = with_provenance(found, scene, history.scene_file, history.scene_text)
    if history.settings is not None:
        try:
            settings = ReconstructSettings.model_validate(dict(history.settings))
        except ValidationError as e:
            where = f"{path}: settings in its history"
            raise InputFileError(explain_errors(where, e, ReconstructSettings, history.settings)) from None
        report("reconstructing")
        found = pipeline.reconstruct(found, settings=settings)
        end_if_interrupted(found.status)
    what = "height" if isinstance(before, Reconstruction) else "counts"
    pairs = [(getattr(a, what), getattr(b, what)) for a, b in zip(_parts(before), _parts(found), strict=True)]
    is_equal = all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)
    largest = max(float(np.nanmax(np.abs(a - b), initial=0.0)) if a.shape == b.shape else np.inf for a, b in pairs)
    return Rerun(found, what, is_equal, largest, history.version)


def _parts(obj: MicrographStack | MicrographSet | Reconstruction) -> tuple[Any, ...]:
    """Return the stacks of a set, or the object alone."""
    return obj.stacks if isinstance(obj, MicrographSet) else (obj,)
