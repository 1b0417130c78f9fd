"""Checks of every command's outputs against its inputs before any work.

A command's annotations mark which files it reads and which it writes. `Command` refuses an output that is an input, two
outputs in one file, an output that could not be written, and one that exists, unless `--force` is given. Every command
has `--quiet`, every command that writes `--force`. Imports nothing heavy, so that `helio --help` is fast.
"""

import functools
import inspect
import itertools
import sys
import typing
from collections.abc import Iterable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from helio_jax.commands.interrupts import INTERRUPTED
from helio_jax.commands.log import logged
from helio_jax.formats.suffixes import HDF5_SUFFIXES


@dataclass(frozen=True)
class Reads:
    """Mark of an argument or option: files that the command reads.

    Attributes:
        names_files: it may be a scene or an instrument file, whose own files are read, too.
    """

    names_files: bool = False


@dataclass(frozen=True)
class Writes:
    """Mark of an argument or option: a file, or a folder of files, that the command writes.

    Attributes:
        what: what it is written as, for messages.
        suffixes: that it may have, lower case; none: any.
        beside: suffixes of further files that are written beside it.
        picture: suffix of a picture of it that is drawn beside it and replaces an earlier one.
        within: names of the files that are written in it: it is a folder.
        keeps: the command adds to what is there, or checks itself whether it is its own.
    """

    what: str = "a file"
    suffixes: tuple[str, ...] = ()
    beside: tuple[str, ...] = ()
    picture: str = ""
    within: tuple[str, ...] | None = None
    keeps: bool = False

    def check_suffix(self, label: str, path: Path) -> None:
        """Refuse another suffix than those known (exit code 2)."""
        if self.suffixes and path.suffix.lower() not in self.suffixes:
            known = " or ".join(self.suffixes)
            raise typer.BadParameter(
                f"{label}: {path} is written as {self.what}: give it the suffix {known}, got {path.suffix!r}"
            )

    def files(self, label: str, path: Path) -> list[tuple[str, Path]]:
        """List the files that are written: what names each, and its path."""
        from helio_jax.formats.safe import files_within

        if self.within is not None:
            return files_within(label, path, self.within)
        beside = (*self.beside, self.picture) if self.picture else self.beside
        return [(label, path), *((f"{label}: the {s} beside it", path.with_suffix(s)) for s in beside)]

    def kept(self, label: str, path: Path) -> list[tuple[str, Path]]:
        """List those of them that are not replaced without --force."""
        if self.keeps:
            return []
        picture = path.with_suffix(self.picture) if self.picture else None
        return [(name, file) for name, file in self.files(label, path) if file != picture]


def marks_of(function: Any) -> dict[str, Reads | Writes]:
    """Collect the mark of every parameter that has one."""
    hints = typing.get_type_hints(function, include_extras=True)
    marks = ((name, m) for name, hint in hints.items() for m in getattr(hint, "__metadata__", ()))
    return {name: mark for name, mark in marks if isinstance(mark, (Reads, Writes))}


Force = Annotated[bool, typer.Option("--force", help="Replace files that exist.")]


Quiet = Annotated[bool, typer.Option("--quiet", help="No progress and no messages, only results, warnings, errors.")]
Log = Annotated[
    Path | None,
    typer.Option("--log", metavar="FILE", help="Append to this file: the command, messages, warnings, times."),
    Writes("a log", keeps=True),
]
is_quiet: ContextVar[bool] = ContextVar("is_quiet", default=False)
"""Whether the running command was given `--quiet`."""


def with_common_options(function: Any) -> Any:
    """Add `--quiet`, `--log`, and `--force` to what writes and has no such option itself; `Command` acts on them."""
    signature = inspect.signature(function)
    has_outputs = any(isinstance(m, Writes) and not m.keeps for m in marks_of(function).values())
    options = {"force": Force} if has_outputs and "force" not in signature.parameters else {}
    options = options | {"quiet": Quiet, "log": Log}

    @functools.wraps(function)
    def command(*args: Any, **given: Any) -> Any:
        return function(*args, **{name: value for name, value in given.items() if name not in options})

    added = [
        inspect.Parameter(n, inspect.Parameter.KEYWORD_ONLY, default=None if n == "log" else False, annotation=a)
        for n, a in options.items()
    ]
    command.__signature__ = signature.replace(parameters=[*signature.parameters.values(), *added])  # type: ignore
    command.__annotations__ = {**function.__annotations__, **options}
    return command


def keep_existing(files: Iterable[tuple[str, Path]]) -> None:
    """Refuse to replace files that exist; a run that is unfinished goes on, which replaces nothing.

    Args:
        files: what names each, and its path.
    """
    from helio_jax.errors import SceneError
    from helio_jax.formats.parts import Parts
    from helio_jax.formats.safe import check_new

    files = list(files)
    if any(Parts(path).exist for _, path in files):
        return
    for label, path in files:
        try:
            check_new(path)
        except SceneError as e:
            raise SceneError(f"{label}: {e}") from None


class Command(TyperCommand):
    """A command of helio; commas between the numbers of an option are refused: they are separated by spaces."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse as usual, after a check that no option of several values was given one word with commas."""
        several = {name: option for option in self.params if option.nargs > 1 for name in option.opts}
        for word, following in itertools.zip_longest(args, args[1:], fillvalue=""):
            name, _, value = word.partition("=")
            value = value or following
            if name in several and "," in value:
                shown = " ".join(v for v in value.split(",") if v)
                raise typer.BadParameter(
                    f"{name} takes its {several[name].nargs} values with spaces between, got "
                    f"{value!r}: write {name} {shown}"
                )
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Check what the command would write, then run it."""
        marks = marks_of(self.callback)
        for label, mark, path in self._given(ctx, marks, Writes):
            mark.check_suffix(label, path)
        written = list(self._given(ctx, marks, Writes))
        outputs = [file for label, mark, path in written for file in mark.files(label, path)]
        if outputs:
            from helio_jax.formats.safe import check_outputs
            from helio_jax.workflows.scene_file import files_read

            inputs = []
            for label, mark, path in self._given(ctx, marks, Reads):
                has_files = mark.names_files and path.suffix.lower() not in HDF5_SUFFIXES
                inputs += files_read(path, label) if has_files else [(label, path)]
            check_outputs(inputs, outputs)
            if not ctx.params.get("force"):
                keep_existing(file for label, mark, path in written for file in mark.kept(label, path))
        token = is_quiet.set(bool(ctx.params.get("quiet")))
        try:
            with logged(ctx.params.get("log")):
                return super().invoke(ctx)
        except KeyboardInterrupt:  # typer would say nothing
            print(INTERRUPTED, file=sys.stderr, flush=True)
            raise typer.Exit(130) from None
        finally:
            is_quiet.reset(token)

    def _given(self, ctx: Any, marks: dict[str, Any], kind: type) -> Iterator[tuple[str, Any, Path]]:
        """Yield the paths given for marks of a kind: what names it (-o, STACK), the mark, the path."""
        for param in self.params:
            mark, value = marks.get(param.name or ""), ctx.params.get(param.name)
            if isinstance(mark, kind) and value is not None:
                own = getattr(param, "metavar", None) or str(param.name).upper()
                label = min(param.opts, key=len) if param.param_type_name == "option" else own
                for one in value if isinstance(value, (list, tuple)) else [value]:
                    yield label, mark, Path(one)
