"""Effects that a simulation may lack, added one at a time when it is compared with a measurement.

Each changes the scene's settings, the response of the instrument or the sum of the images, by a typical size.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from helio_jax.instrument import Instrument
from helio_jax.scene.shapes import SpheresSample
from helio_jax.scores.agreement import Terms
from helio_jax.workflows.scene_file import SceneFile


@dataclass(frozen=True)
class Images:
    """A simulated experiment, as detection probabilities per beam atom, with the variance of their sum.

    All images [detector, y, x] but the sample's true height [y, x], um. `unmasked`: single scattering, nothing masked.
    """

    instrument: Instrument
    single: np.ndarray
    multiple: np.ndarray
    unmasked: np.ndarray
    variance: np.ndarray
    height: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """Single and multiple scattering."""
        return self.single + self.multiple


@dataclass(frozen=True)
class Effect:
    """One effect that a simulation may lack.

    Attributes:
        name: for the table.
        changes: settings of the scene, computed from the scene; None: the effect does not apply.
        terms: of the normalisation, instead of the usual ones.
        total: sum of the images.
        is_geometry: heights are computed with the changed instrument; otherwise the change of the images is subtracted.
    """

    name: str
    changes: Callable[[SceneFile], Mapping[str, Any] | None] = lambda scene: {}
    terms: Terms = field(default_factory=Terms)
    total: Callable[[Images], np.ndarray] = lambda images: images.total
    is_geometry: bool = False


def _distance(factor: float) -> Callable[[SceneFile], Mapping[str, Any]]:
    return lambda scene: {"plate.sample_distance_um": factor * scene.sample_distance}


def _plate_for_sample_distance(scene: SceneFile) -> Mapping[str, Any] | None:
    """Scale plate and apertures as if the plate had been made for the distance at which the sample stands."""
    f = scene.sample_distance / scene.working_distance
    if f == 1.0:
        return None
    out: dict[str, Any] = {
        "plate.working_distance_um": f * scene.working_distance,
        "plate.sample_distance_um": scene.sample_distance + (f - 1.0) * scene.working_distance,
    }
    for k, d in enumerate(scene.detector):
        if d.center_um is not None and d.axes_um is not None:
            out |= {f"detector.{k}.center_um": [f * v for v in d.center_um]}
            out |= {f"detector.{k}.axes_um": [f * v for v in d.axes_um]}
    return out


def _tilt(axis: int) -> Callable[[SceneFile], Mapping[str, Any]]:
    def change(scene: SceneFile) -> Mapping[str, Any]:
        angles = list(scene.sample.rotate_deg)
        angles[axis] += 1.0
        return {"sample.rotate_deg": angles}

    return change


def _moat(scene: SceneFile) -> Mapping[str, Any] | None:
    if not isinstance(scene.sample, SpheresSample) or any(s.moat is not None for s in scene.sample.spheres):
        return None
    return {
        f"sample.spheres.{i}.moat": {"width_um": 0.1 * s.radius_um, "depth_um": 0.1 * s.radius_um}
        for i, s in enumerate(scene.sample.spheres)
    }


def _scattering_plate(scene: SceneFile) -> Mapping[str, Any] | None:
    if scene.plate.kind != "transparent":
        return None
    return {"plate.kind": "scattering", "plate.radius_um": 3.0 * scene.working_distance}


def _rough_law(scene: SceneFile) -> Mapping[str, Any] | None:
    if scene.used_materials:
        return None
    law = {"material.rough": {"kind": "rough_diffuse", "roughness": 0.3}}
    if isinstance(scene.sample, SpheresSample):
        law |= {f"sample.spheres.{i}.material": "rough" for i in range(len(scene.sample.spheres))}
    return law | {"sample.material": "rough"}


def _wide_spot(scene: SceneFile) -> Mapping[str, Any]:
    return {"beam.pinhole_radius_um": 0.5 * (scene.scan.spacing or 0.0)}


LAG = "detector lag"
BARE = Terms(offset=False, drift=0, along=False)
EFFECTS = (
    Effect("offset: a constant background", terms=replace(BARE, offset=True)),
    Effect("slow drift of the background", terms=replace(BARE, offset=True, drift=3)),
    Effect("slope along the fast axis", terms=Terms()),
    Effect("gain that drifts evenly", terms=Terms(gain_drift=1)),
    Effect(LAG),
    Effect("sample 10 % nearer to the plate", _distance(0.9), is_geometry=True),
    Effect("sample 10 % farther from the plate", _distance(1.1), is_geometry=True),
    Effect("plate and apertures scaled to the sample's distance", _plate_for_sample_distance, is_geometry=True),
    Effect("sample tilted by 1 deg about x", _tilt(0)),
    Effect("sample tilted by 1 deg about y", _tilt(1)),
    Effect("moat around the spheres, a tenth of a radius", _moat),
    Effect("plate scatters", _scattering_plate),
    Effect("rough-diffuse law, roughness 0.3", _rough_law),
    Effect("spot as wide as a pixel", _wide_spot),
    Effect("no multiple scattering", total=lambda images: images.single),
    Effect("no masks", total=lambda images: images.unmasked + images.multiple),
)
"""Effects of `explain`: the first three build up the usual normalisation, the others start from it."""
