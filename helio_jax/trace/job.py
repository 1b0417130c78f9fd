"""What is traced: a scan's description under a key, cut into units of work.

The key is a hash of everything that the result depends on: scene, settings of the tracer, the sample's surface, this
program's code and the libraries under it. Two results belong together when their keys are equal; when not,
`differences` says why.
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
"""Pixels of a unit at most, so that its maps of cause need no more memory than a block of rays."""
SURFACE_STEP = 1e-7
"""Surfaces are the same when their coordinates agree to this share of their size: CPUs differ in a sine's last bit."""
LAW_STEP = 1e-9
"""Likewise for the numbers of scattering laws, which are of order 1."""
_PROGRAM = ("trace/*.py", "scene/*.py", "instrument.py", "detector.py")
_LIBRARIES = ("numpy", "numba", "embreex")


@dataclass(frozen=True)
class Unit:
    """A run of pixels in scan order: `start` up to and without `stop`."""

    number: int
    start: int
    stop: int


@dataclass(frozen=True, eq=False)
class Job:
    """What all units of a scan have in common; small and made to be sent.

    Attributes:
        scene: what is imaged.
        settings: how it is traced.
        about: everything that the result depends on, as JSON-compatible values: `key` is its hash.
    """

    scene: Scene
    settings: TraceSettings
    about: dict[str, Any]

    @classmethod
    def of(cls, scene: Scene, settings: TraceSettings, body: Body) -> "Job":
        """Describe the tracing of a scene whose surface is `body`."""
        file = getattr(scene.sample, "file", None)
        if scene.plate.is_mesh:  # maps of cause are of apertures in a flat plate
            settings = settings.model_copy(update={"maps": False})
        about = {
            "scene": scene.model_dump(mode="json", include=set(Scene.model_fields) - {"description"}),
            "trace": settings.model_dump(mode="json", exclude={"workers"}),
            "the materials' laws": _hash(scene.read_laws(), LAW_STEP),
            "the beam's rays": _hash(scene.read_rays(), LAW_STEP),
            "the sample's surface": _hash_body(body) + (f" from {Path(file).name}" if file else ""),
            **_list_of_positions(scene),
            **({} if (plate := scene.read_plate()) is None else {"the plate's surface": _hash_body(plate)}),
            "program": {
                "helio_jax": f"{helio_jax.__version__}, sources {_hash_program()}",
                **{name: _version(name) for name in _LIBRARIES},
            },
        }
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
        """Pixels of all views; those of one view follow those of the one before."""
        return self.n_view_pixels * len(self.views)

    @functools.cached_property
    def views(self) -> tuple[View, ...]:
        """Views of the scan."""
        return self.scene.views()

    @functools.cached_property
    def n_view_pixels(self) -> int:
        """Pixels of one view."""
        return math.prod(self.scene.image_shape)

    def units(self) -> list[Unit]:
        """Return the units of the scan, none across two views; they depend on the job alone, not on who runs them."""
        n_rays, n_branches = paths_of(self.settings)
        n_paths = (self.settings.max_rays if self.settings.has_target else n_rays) * n_branches
        if effusive := self.scene.beam.effusive:
            n_paths += math.prod(paths_of(effusive_settings(self.settings, effusive)))
        size = min(max(1, self.settings.paths_per_unit // n_paths), MAX_PIXELS)
        n = self.n_view_pixels
        runs = [
            (s, min(s + size, first + n)) for first in range(0, self.n_pixels, n) for s in range(first, first + n, size)
        ]
        return [Unit(i, start, stop) for i, (start, stop) in enumerate(runs)]

    def view_number(self, unit: Unit) -> int:
        """Return which of the views a unit is of."""
        return unit.start // self.n_view_pixels

    def pixels(self, start: int, stop: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return numbers and beam positions x, y [um] of a run of pixels of one view."""
        ids = np.arange(start, stop)
        return ids, *self.scene.points(ids % self.n_view_pixels)


def _list_of_positions(scene: Scene) -> dict[str, str]:
    """Return what tells a list of positions that is in a file."""
    is_list = isinstance(scene.scan, PositionList)
    return {"the scan's positions": _hash(scene.scan.read(scene.base_dir), LAW_STEP)} if is_list else {}  # type: ignore[union-attr]


def differences(then: Any, now: Any, names: tuple[str, str], place: str = "") -> list[str]:
    """Say in which places two trees of JSON values differ; `names` are what to call the one and the other."""
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
    """Return the CPU's architecture and widest vector instructions: Embree and NumPy choose their code by them."""
    found = llvm.get_host_cpu_features()
    kinds = ("avx512f", "avx2", "avx", "sse4.2", "sse2", "sve", "neon")
    return f"{platform.machine()} {next((k for k in kinds if found.get(k)), 'scalar')}"


def _hash_body(body: Body) -> str:
    """Return a hash of a surface that does not depend on the CPU which built it."""
    return _hash(body, SURFACE_STEP * float(np.ptp(body.bounds, axis=0).max()))


def _hash(value: Any, step: float) -> str:
    """Return a hash of a tree of records, tables and arrays, whose numbers agree to `step`."""
    digest = hashlib.sha256()
    for piece in _pieces(value, step):
        digest.update(piece)
    return digest.hexdigest()[:16]


def _pieces(value: Any, step: float) -> Iterator[bytes]:
    """Yield what identifies a tree of records, tables and arrays; floating-point numbers are rounded to `step`."""
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
    """Return a hash of the source files that a unit runs."""
    root = Path(__file__).resolve().parents[1]
    digest = hashlib.sha256()
    for path in sorted(path for pattern in _PROGRAM for path in root.glob(pattern)):
        digest.update(path.name.encode() + path.read_bytes().replace(b"\r\n", b"\n"))
    return digest.hexdigest()[:16]


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
