"""The history of a file, as far as it can be repeated: the scene, the noise, the settings of the reconstruction."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from helio_jax.errors import InputFileError
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.reconstruction import Reconstruction

_MEASURED = {"source": "imported", "calibrate": "calibrated", "align": "aligned", "orient": "oriented"}
"""Entries of the history that depend on files which are not in it."""


@dataclass(frozen=True)
class History:
    """How simulated data were made.

    Attributes:
        scene: all settings of the scene.
        is_noisy: whether counting noise was added to expected counts.
        settings: all settings of the reconstruction; None: not reconstructed.
        version: of the program that made them.
        scene_file, scene_text: name and text of the scene file.
    """

    scene: Mapping[str, Any]
    is_noisy: bool
    settings: Mapping[str, Any] | None
    version: str
    scene_file: str
    scene_text: str


def scene_of(rec: Reconstruction) -> Mapping[str, Any] | None:
    """Return the settings of the scene that was simulated, whatever was done since; None: measured or not known."""
    about = rec.provenance.get("stack")
    scene = about.get("scene") if isinstance(about, Mapping) else None
    return scene if isinstance(scene, Mapping) else None


def history_of(obj: MicrographStack | MicrographSet | Reconstruction, name: str) -> History:
    """Return how an object was made.

    Args:
        obj: read from a file.
        name: of the file, for messages.

    Raises:
        InputFileError: it was not simulated, or its history is incomplete.
    """
    about, settings = obj.provenance, None
    if isinstance(obj, Reconstruction):
        settings, about = about.get("reconstruct"), about.get("stack", {})
        if not isinstance(settings, Mapping):
            raise InputFileError(f"{name}: its history has no settings of the reconstruction: it cannot be repeated")
    steps = [word for key, word in _MEASURED.items() if isinstance(about, Mapping) and key in about]
    if not isinstance(about, Mapping) or not isinstance(about.get("scene"), Mapping) or steps:
        why = f"it was {' and '.join(steps)}" if steps else "its history has no scene"
        raise InputFileError(f"{name}: only what was simulated can be repeated, {why}: repeat its commands by hand")
    own = obj.stacks[0].provenance if isinstance(obj, MicrographSet) else about
    versions = about.get("versions")
    version = versions.get("helio-jax", "unknown") if isinstance(versions, Mapping) else "unknown"
    file, text = str(about.get("scene_file", "")), str(about.get("scene_text", ""))
    return History(about["scene"], "noise" in own, settings, str(version), file, text)
