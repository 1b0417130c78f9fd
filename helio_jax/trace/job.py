"""Description of a scan to be traced (`Job`) and its units of work.

The key of a job is a hash of everything that the result depends on: scene, settings of the tracer, the sample's
surface, this program's code and its libraries. Results may be merged if their keys are equal; if not, `differences`
lists why.
"""

import functools
import hashlib
import importlib.metadata
import json
import math
import platform
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from llvmlite import binding as llvm

import helio_jax
from helio_jax.scene.body import Body
from helio_jax.scene.scan import PositionList
from helio_jax.scene.scene import Scene
from helio_jax.scene.views import View
from helio_jax.trace.run import effusive_settings, paths_of
from helio_jax.trace.settings import TraceSettings

MAX_PIXELS = 65536
"""Limit of pixels per unit, so that its maps need no more memory than a block of rays."""
SURFACE_STEP = 1e-7
"""Rounding of coordinates before hashing, relative to the size: CPUs differ in the last bit of a sine."""
LAW_STEP = 1e-9
"""Rounding of the numbers of scattering laws, which are of order 1."""
_PROGRAM = ("trace/*.py", "scene/*.py", "instrument.py", "detector.py")
_LIBRARIES = ("numpy", "numba", "embreex")


@dataclass(frozen=True)
class Unit:
    """Pixels `start` to `stop` (exclusive) in scan order."""

    number: int
    start: int
    stop: int


@dataclass(frozen=True, eq=False)
class Job:
    """Common description of all units of a scan, small enough to send to other processes.

    Attributes:
        scene: sample and instrument.
        settings: of the tracer.
        about: everything that the result depends on, as JSON-compatible values; `key` is its hash.
    """

    scene: Scene
    settings: TraceSettings
    about: dict[str, Any]

    @classmethod
    def of(cls, scene: Scene, settings: TraceSettings, body: Body) -> "Job":
        """Make the job of a scene whose surface is `body`."""
        file = getattr(scene.sample, "file", None)
        if scene.plate.is_mesh:  # maps need apertures in a flat plate
            settings = settings.model_copy(update={"maps": False})
        about = {
            "scene": scene.model_dump(mode="json", include=set(Scene.model_fields) - {"description"}),
            "trace": settings.model_dump(mode="json", exclude={"workers"}),
            "the materials' laws": _hash(scene.read_laws(), LAW_STEP),
            "the beam's rays": _hash(scene.read_rays(), LAW_STEP),
            "the sample's surface": _hash_body(body) + (f" from {Path(file).name}" if file else ""),
            "program": {
                "helio_jax": f"{helio_jax.__version__}, sources {_hash_program()}",
                **{name: package_version(name) for name in _LIBRARIES},
            },
        }
        if isinstance(scene.scan, PositionList):
            about["the scan's positions"] = _hash(scene.scan.read(scene.base_dir), LAW_STEP)
        if (plate := scene.read_plate()) is not None:
            about["the plate's surface"] = _hash_body(plate)
        return cls(scene.with_base_dir(scene.base_dir.resolve()), settings, about)

    @functools.cached_property
    def key(self) -> str:
        """Hash of `about`."""
        return hashlib.sha256(json.dumps(self.about, sort_keys=True).encode()).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Job) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)

    @property
    def n_pixels(self) -> int:
        """Pixels of all views, view after view."""
        return self.n_view_pixels * len(self.views)

    @functools.cached_property
    def views(self) -> tuple[View, ...]:
        """Views of the scan."""
        return self.scene.views()

    @functools.cached_property
    def n_view_pixels(self) -> int:
        """Pixels of one view."""
        return math.prod(self.scene.image_shape)

    @property
    def paths_per_pixel(self) -> tuple[int, int]:
        """Paths per pixel of the beam (without a target) and of the effusive beam."""
        effusive = self.scene.beam.effusive
        n_effusive = math.prod(paths_of(effusive_settings(self.settings, effusive))) if effusive else 0
        return math.prod(paths_of(self.settings)), n_effusive

    def units(self) -> list[Unit]:
        """Return the units of the scan, none across two views; a function of the job alone."""
        n_beam, n_effusive = self.paths_per_pixel
        if self.settings.has_target:
            n_beam = self.settings.max_rays * self.settings.branches
        size = min(max(1, self.settings.paths_per_unit // (n_beam + n_effusive)), MAX_PIXELS)
        n = self.n_view_pixels
        runs = [
            (s, min(s + size, first + n)) for first in range(0, self.n_pixels, n) for s in range(first, first + n, size)
        ]
        return [Unit(i, start, stop) for i, (start, stop) in enumerate(runs)]

    def view_number(self, unit: Unit) -> int:
        """Return the index of the view that a unit belongs to."""
        return unit.start // self.n_view_pixels

    def pixels(self, start: int, stop: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return numbers and beam positions x, y [um] of the pixels `start` to `stop` of one view."""
        ids = np.arange(start, stop)
        return ids, *self.scene.points(ids % self.n_view_pixels)


def differences(then: Any, now: Any, names: tuple[str, str], place: str = "") -> list[str]:
    """List the places where two trees of JSON values differ; `names` label the two."""
    if isinstance(then, (list, tuple)) and isinstance(now, (list, tuple)) and len(then) == len(now):
        then, now = dict(enumerate(then)), dict(enumerate(now))
    if isinstance(then, dict) and isinstance(now, dict):
        keys = dict.fromkeys([*then, *now])
        inner = ((f"{place}.{key}".lstrip("."), key) for key in keys)
        return [line for at, key in inner for line in differences(then.get(key), now.get(key), names, at)]
    return [] if then == now else [f"{place}: {_short(then)} ({names[0]}), {_short(now)} ({names[1]})"]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else text[:77] + "..."


@functools.cache
def instruction_set() -> str:
    """Return architecture and widest vector instructions of the CPU, by which Embree and NumPy choose their code."""
    found = llvm.get_host_cpu_features()
    kinds = ("avx512f", "avx2", "avx", "sse4.2", "sse2", "sve", "neon")
    return f"{platform.machine()} {next((k for k in kinds if found.get(k)), 'scalar')}"


def _hash_body(body: Body) -> str:
    """Hash a surface, independent of the CPU that built it."""
    return _hash(body, SURFACE_STEP * float(np.ptp(body.bounds, axis=0).max()))


def _hash(value: Any, step: float) -> str:
    """Hash a tree of records, tables and arrays, floating-point numbers rounded to `step`."""
    digest = hashlib.sha256()
    for piece in _pieces(value, step):
        digest.update(piece)
    return digest.hexdigest()[:16]


def _pieces(value: Any, step: float) -> Iterator[bytes]:
    """Yield the bytes that `_hash` hashes."""
    if isinstance(value, float):
        value = np.asarray(value)
    if is_dataclass(value):
        value = {f.name: getattr(value, f.name) for f in fields(value)}
    if isinstance(value, Mapping):
        value = tuple(value.items())
    if isinstance(value, (tuple, list)):
        for item in value:
            yield from _pieces(item, step)
    elif isinstance(value, np.ndarray):
        rounded = np.round(value / step).astype(np.int64) if value.dtype.kind == "f" else value
        yield repr(value.shape).encode() + rounded.tobytes()
    else:
        yield repr(value).encode()


@functools.cache
def _hash_program() -> str:
    """Hash the source files that a unit runs."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for path in sorted(path for pattern in _PROGRAM for path in root.glob(pattern)):
        digest.update(path.name.encode() + path.read_bytes().replace(b"\r\n", b"\n"))
    return digest.hexdigest()[:16]


def package_version(name: str) -> str:
    """Return the version of an installed package, or "not installed"."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
