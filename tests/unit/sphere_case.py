"""A sphere cap on a flat seen by an oblique beam, in closed form: the input of the evaluate stage's tests."""

import numpy as np

from helio_jax.instrument import Beam, Detector, Instrument, Plate
from helio_jax.micrograph import MicrographStack
from helio_jax.reconstruction import Reconstruction
from helio_jax.scores.metrics import Region, Truth

RADIUS, CAP = 1000.0, 720.0
TAN = np.tan(np.radians(30.0))


def first_hit(x, y, center=(0.0, 0.0)):
    """Return height [y, x] and normal [y, x, 3] of the first hit of the ray (X - h tan t, Y, h), h falling."""
    gx, gy = np.meshgrid(x - center[0], y - center[1])
    a, b, c0 = 1 + TAN**2, -2 * gx * TAN - 2 * (CAP - RADIUS), gx**2 + gy**2 + (CAP - RADIUS) ** 2 - RADIUS**2
    inside = b * b - 4 * a * c0
    h = (-b + np.sqrt(np.maximum(inside, 0.0))) / (2 * a)
    is_hit = (inside > 0) & (h > 0)
    h = np.where(is_hit, h, 0.0)
    normal = np.stack([gx - h * TAN, gy, h - (CAP - RADIUS)], -1) / RADIUS
    return h, np.where(is_hit[..., None], normal, [0.0, 0.0, 1.0])


def make_case(nx=81, ny=91, n_detectors=3, pitch=40.0, seed=0):
    """Return (stack, reconstruction equal to the truth, truth)."""
    rng = np.random.default_rng(seed)
    x, y = (np.arange(nx) - (nx - 1) / 2) * pitch, (np.arange(ny) - (ny - 1) / 2) * pitch
    height, normals = first_hit(x, y)
    detectors = tuple(
        Detector(name=f"D{k + 1}", polar_deg=35.0, azimuth_deg=360.0 * k / n_detectors, half_angle_deg=12.0)
        for k in range(n_detectors)
    )
    plate = Plate(working_distance_um=4000.0, sample_distance_um=4720.0)
    instrument = Instrument(beam=Beam(incidence_deg=30.0), plate=plate, detector=detectors)
    phi = 2 * np.pi * np.arange(n_detectors) / n_detectors
    toward = np.stack([0.57 * np.cos(phi), 0.57 * np.sin(phi), np.full(n_detectors, 0.82)])
    single = 500.0 * np.clip(np.moveaxis(normals @ toward, -1, 0), 0.0, None)
    counts = rng.poisson(single + 20.0).astype(float)
    masked = np.clip(1 - single / 150.0, 0.0, 1.0)
    stack = MicrographStack(
        counts, x, y, instrument, variance=np.maximum(counts, 1.0), by_order=np.stack([single, 0 * single + 20.0]),
        masked=masked, shadowed=np.zeros_like(height), noise="poisson", name="sphere",
    )  # fmt: skip
    is_valid = masked.max(0) < 0.9
    rec = Reconstruction(
        height, x, y, instrument, "refine", normals, np.ones_like(height), is_valid, np.where(is_valid, 0, 2),
        residuals=rng.normal(size=counts.shape), gain=np.ones(n_detectors), offset=np.zeros(n_detectors),
        status="converged", provenance={"seed": 7, "note": "</script><b>&"},
    )  # fmt: skip
    return stack, rec, Truth(height, normals, Region(CAP))
