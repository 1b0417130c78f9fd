"""The reference program's counts in our frame, and our expectation for each set; used by tests and benchmarks.

Frame of the files: plate y = 0, sample at y < 0, apertures in (x, z), mm. Ours: x = x, y = -z, z = y. The sample moves
by (X, Z), so the beam meets it at our (-X, +Z).
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.scene.shapes import Sphere, SpheresSample
from helio_jax.scene.surfaces import Body, flat_body
from helio_jax.trace.run import make_experiment, trace_pixels
from helio_jax.trace.settings import TraceSettings


@dataclass(frozen=True)
class CountSet:
    """One reference set: counts [pixels, detector, order] at beam positions x, y [um], with its scene."""

    name: str
    counts: np.ndarray
    x: np.ndarray
    y: np.ndarray
    n_rays: int
    instrument: Instrument
    body: Body

    def expect(self, settings: TraceSettings) -> tuple[np.ndarray, np.ndarray]:
        """Return our expected counts and their variance [pixels, detector, order]."""
        tally = trace_pixels(make_experiment(self.body, self.instrument, settings), self.x, self.y)
        mean, variance = tally.probability()
        return self.n_rays * mean.transpose(2, 1, 0), self.n_rays**2 * variance.transpose(2, 1, 0)


def reference_instrument(about: dict, source: str, distance_um: float, rotation_sign: float = -1.0) -> Instrument:
    """Return the instrument of a set's JSON; `rotation_sign` = +1 is the wrong model of the ellipse rotation."""
    detectors, beam = about["detectors"], about[source]
    n = detectors["n_detectors"]
    model = {"Uniform": "uniform", "Gaussian": "gaussian"}[beam["model"]]
    size = beam["theta_max_rad"] if model == "uniform" else beam["sigma_rad"]
    return Instrument(
        beam=Beam(
            incidence_deg=beam["incidence_deg"],
            pinhole_radius_um=1e3 * beam["pinhole_radius"],
            source="pencil" if size == 0 else "uniform" if model == "uniform" else "gaussian",
            source_size_mrad=1e3 * size,
        ),
        plate=Plate(working_distance_um=1e3 * beam["design_wd"], sample_distance_um=distance_um),
        detector=tuple(
            Detector(
                name=f"d{k + 1}",
                center_um=(1e3 * detectors["centres_x_z"][2 * k], -1e3 * detectors["centres_x_z"][2 * k + 1]),
                axes_um=(1e3 * detectors["full_axes_x_z"][2 * k], 1e3 * detectors["full_axes_x_z"][2 * k + 1]),
                rotation_deg=rotation_sign * detectors["rotation_deg"][k],
            )
            for k in range(n)
        ),
    )


def sphere_body(cap_height_um: float = 720.0) -> Body:
    """Return sphere A, or one buried wrongly."""
    return SpheresSample(spheres=(Sphere(radius_um=1000.0, cap_height_um=cap_height_um),), size_um=8000.0).build()


def _load(shared: Path, name: str) -> tuple[dict, dict[str, np.ndarray]]:
    about = json.loads((shared / "reference" / f"{name}.json").read_text())
    with np.load(shared / "reference" / f"{name}.npz", allow_pickle=False) as arrays:
        return about, {key: arrays[key] for key in arrays.files}


def sphere_set(
    shared: Path, rotation_sign: float = -1.0, cap_height_um: float = 720.0, mirror: bool = False
) -> CountSet:
    """Return sphere_A_53x61; the keyword arguments make wrong models."""
    about, data = _load(shared, "sphere_A_53x61")
    z, x = np.meshgrid(1e3 * data["z"], 1e3 * data["x"], indexing="ij")
    instrument = reference_instrument(about, "source", 4720.0, rotation_sign)
    counts = data["hist"].reshape(-1, *data["hist"].shape[2:])
    sign = 1.0 if mirror else -1.0
    body = sphere_body(cap_height_um)
    return CountSet("sphere_A_53x61", counts, sign * x.ravel(), z.ravel(), about["rays_per_pixel"], instrument, body)


def broad_sets(shared: Path) -> list[CountSet]:
    """Return the two lines with broad sources."""
    about, data = _load(shared, "sphere_A_broad_sources")
    out = []
    for kind, key in (("source_gaussian", "gauss_hist"), ("source_uniform", "uniform_hist")):
        x = -1e3 * data["x"]
        instrument = reference_instrument(about, kind, 4720.0)
        out.append(CountSet(kind, data[key][0], x, 0.0 * x, about["rays_per_pixel"], instrument, sphere_body()))
    return out


def flat_sets(shared: Path) -> list[tuple[CountSet, np.ndarray]]:
    """Return the flat at each distance with the file's own cosine-law integral [detector]."""
    about, data = _load(shared, "flat_cosine_vs_wd")
    out = []
    for h, hist, exact in zip(data["h"], data["hist"], data["expected_fraction"], strict=True):
        instrument = reference_instrument(about, "source", 1e3 * h)
        # the beam's lab position is fixed: it meets a flat at depth h where the axis does, our (0, 0)
        count_set = CountSet(
            f"flat {h:g} mm", hist[None], np.zeros(1), np.zeros(1), about["rays_per_pixel"], instrument, flat_body(2e5)
        )
        out.append((count_set, exact))
    return out


def trench_sets(shared: Path) -> list[tuple[CountSet, np.ndarray]]:
    """Return the two lines over the slot, with the reference's number of stopped rays per pixel."""
    about, data = _load(shared, "box_trench_lines")
    triangles = data["triangles"]  # mm; frame of that program
    vertices = 1e3 * np.stack([triangles[..., 0], -triangles[..., 2], triangles[..., 1] + 4.0], -1)
    normals = np.stack([data["normals"][:, 0], -data["normals"][:, 2], data["normals"][:, 1]], -1)
    cross = np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])
    is_turned = np.sum(cross * normals, -1) < 0
    vertices[is_turned] = vertices[is_turned][:, ::-1]
    body = Body(vertices.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3), np.zeros((0, 4)))
    instrument = reference_instrument(about, "source", 4000.0)
    x, y = -1e3 * data["x"], 1e3 * data["z"]
    rays = about["rays_per_pixel"]
    return [
        (
            CountSet("trench z", data["z_hist"][:, 0], 0 * y, y, rays["z_line"], instrument, body),
            data["z_killed"][:, 0],
        ),
        (CountSet("trench x", data["x_hist"][0], x, 0 * x, rays["x_line"], instrument, body), data["x_killed"][0]),
    ]
