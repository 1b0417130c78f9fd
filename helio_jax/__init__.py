"""helio_jax: simulate scanning helium micrographs and turn three or more of them into a height map.

```
Scene - trace -> MicrographStack - prepare -> MicrographStack - reconstruct -> Reconstruction - evaluate -> report
```

Reading order: `arrays` (conventions), the nouns `instrument`, `micrograph`, `heightmap`, `reconstruction`, then one
folder per verb. Which file does what:

* `scene/` what is imaged: `sample` (kinds of samples), `placement` (where they stand), `surfaces` (their geometry),
  `scan` (positions), `views` (distances, rotations), `scene`.
* `trace/` Scene -> MicrographStack, NumPy + Embree + numba: `intersect` (ray-surface hits), `source` (the beam),
  `random`, `direct` (form factor), `experiment`, `transport` (paths), `next_event` (the expected estimator), `tally`,
  `masks` (masked fraction, shadow), `denoise`, `run` (blocks on threads), `converge` (a wanted error), `job`, `units`
  (units of work), `scan` (threads, processes, cluster), `follow` (single atoms).
* `prepare/` `noise` (counting noise), `response` (lag, drift), `calibrate` (first background and gain).
* `reconstruct/` JAX: `solve` (entry), `beamframe`, `formfactor`, `linear` (photometric solution), `integrate*` (slopes
  -> heights), `render` (the differentiable model), `refine` (the fit of the heights).
* `evaluate/` `metrics` (scores), `figures` (PNG), `report` (HTML).
* `formats/` `hdf5` (NeXus), `parts` (finished units), `matlab` (import), `export`, `safe` (untrusted files).
* `config` (scene files), `predict` (tracer and masks for the fit), `checkpoint` (long simulations), `pipeline` (joins
  the stages), `study` (sweeps), `__main__` (command line).

Public names are loaded on first use, so that `import helio_jax` is instant.
"""

import importlib
from typing import Any

__version__ = "0.1.0"

_HOME = {
    "Instrument": "instrument",
    "MicrographStack": "micrograph",
    "MicrographSet": "micrograph",
    "HeightMap": "heightmap",
    "Reconstruction": "reconstruction",
    "HelioError": "errors",
    "load_scene": "workflows.scene_file",
    "load_instrument": "workflows.scene_file",
    "simulate": "workflows.pipeline",
    "reconstruct": "workflows.pipeline",
    "true_height": "workflows.truth",
    "evaluate": "workflows.pipeline",
    "run": "workflows.pipeline",
    "read": "formats.hdf5",
    "write": "formats.hdf5",
    "import_micrographs": "formats.matlab",
}

__all__ = [*sorted(_HOME), "__version__"]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(importlib.import_module(f"helio_jax.{_HOME[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'helio_jax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
