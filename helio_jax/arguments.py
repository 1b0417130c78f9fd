"""Arguments of another type than a public function takes end in an error that names what makes the right one."""

import functools
import inspect
import os
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from helio_jax.errors import WrongType

P = ParamSpec("P")
R = TypeVar("R")
_REMEDIES = {
    "SceneFile": "hx.load_scene(FILE_OR_NAME) makes one",
    "Instrument": "hx.load_instrument(FILE_OR_NAME) makes one",
    "MicrographStack": "hx.simulate, hx.read, hx.import_micrographs or hx.MicrographStack(counts, x, y, instrument) "
    "make one",
    "MicrographSet": "hx.simulate of several views, or hx.MicrographSet(stacks) makes one",
    "Reconstruction": "hx.reconstruct(stack) or hx.read(FILE) makes one",
    "HeightMap": "hx.HeightMap(height, x, y) or hx.read(FILE) makes one",
    "Truth": "hx.true_height(scene, rec) makes one",
    "Profile": "hx.measure_profile makes one",
    "Optics": "hx.Optics.of(instrument) makes one",
    "Raster": "hx.Raster.of(stack) makes one",
    "str": "files that hold records are read by hx.read, hx.load_scene, hx.load_instrument, hx.import_micrographs",
}
"""What makes an argument, by the first type that a parameter takes. Only these types are checked."""


_SHORT = 40
"""A value of fewer letters is shown."""


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Check the arguments of a public function by its annotations: records, and names of files.

    Parameters of other types (numbers, arrays, settings) are left to the function, which knows their limits.
    """
    parameters = inspect.signature(function).parameters
    kinds = {name: found for name, p in parameters.items() if (found := _kinds(p.annotation))}
    positions = list(parameters)

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        given = dict(zip(positions, args, strict=False)) | kwargs
        for name, allowed in kinds.items():
            if name in given:
                expect(f"{function.__name__}: {name}", given[name], *allowed)
        return function(*args, **kwargs)

    return call


def expect(name: str, value: Any, *kinds: type) -> None:
    """Raise WrongType unless a value is of one of some types; `name` of the argument, for the message."""
    if not isinstance(value, kinds):
        names = [kind.__name__ for kind in kinds if kind not in (types.NoneType, os.PathLike, Path)]
        remedy = next((_REMEDIES[known] for known in names if known in _REMEDIES), "see its help")
        wanted = " or ".join("name of a file" if known == "str" else known for known in names)
        raise WrongType(f"{name} must be {_article(wanted)} {wanted}, got {_described(value)}: {remedy}")


def _kinds(annotation: Any) -> tuple[type, ...]:
    """Return the types that an annotation allows, if all are such as are checked."""
    union = typing.get_origin(annotation) in (typing.Union, types.UnionType)
    kinds = typing.get_args(annotation) if union else (annotation,)
    known = [kind for kind in kinds if isinstance(kind, type) and kind.__name__ in _REMEDIES]
    others = [kind for kind in kinds if kind not in known and kind is not types.NoneType]
    return tuple(kinds) if known and all(kind in (os.PathLike, Path) for kind in others) else ()


def _described(value: Any) -> str:
    """Describe a value of a wrong type."""
    kind = type(value).__name__
    if value is None:
        return "None"
    shown = f" {value!r}" if isinstance(value, (str, int, float)) and len(str(value)) < _SHORT else ""
    return f"{_article(kind)} {kind}{shown}"


def _article(word: str) -> str:
    return "an" if word[0].lower() in "aeiou" else "a"
