"""Check of an installation for `helio doctor`: versions, and a small trace against its closed form."""

import math
import os
import platform
from typing import Any

import numpy as np

from helio_jax.instrument import Detector, Instrument, Plate
from helio_jax.scene.surfaces import flat_body
from helio_jax.trace.intersect import Intersector
from helio_jax.trace.job import package_version
from helio_jax.trace.run import make_experiment, trace_pixels
from helio_jax.trace.settings import TraceSettings


def diagnose() -> dict[str, Any]:
    """Return versions and the result of a small trace; `ok` is True if it agrees with the closed form."""
    import jax

    names = ("helio-jax", "numpy", "scipy", "numba", "embreex", "jax", "optimistix", "trimesh", "h5py", "plotly")
    found: dict[str, Any] = {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    found |= {name: package_version(name) for name in names}
    found |= {"cpus": os.cpu_count(), "jax devices": ", ".join(str(d) for d in jax.devices())}
    intersector = Intersector(flat_body(2000.0))
    found["ray engine"] = "embree" if intersector.has_embree else "exhaustive (slow: embreex is not installed)"
    detector = Detector(name="test", polar_deg=45.0, half_angle_deg=10.0)
    instrument = Instrument(plate=Plate(working_distance_um=4000.0), detector=(detector,))
    experiment = make_experiment(flat_body(2000.0), instrument, TraceSettings(rays=8, n_orders=1))
    traced = float(trace_pixels(experiment, np.zeros(1), np.zeros(1)).total()[0][0, 0])
    exact = math.sin(math.radians(10.0)) ** 2 * math.cos(math.radians(45.0))
    found["small trace"] = f"P = {traced:.9f}, closed form {exact:.9f}"
    found["ok"] = bool(abs(traced / exact - 1.0) < 1e-4)
    return found
