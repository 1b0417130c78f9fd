"""The application and shared parts of all commands: options, messages, progress bars, tables.

Every command imports its dependencies itself, so that `helio --help` takes less than 0.2 s. stdout carries results (one
JSON object with --json), stderr progress and messages. Exit codes: errors.py.
"""

import json
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from helio_jax import __version__
from helio_jax.commands.door import Reads, Writes, is_quiet
from helio_jax.commands.group import COMMANDS, Group
from helio_jax.commands.log import log
from helio_jax.formats.suffixes import HDF5_SUFFIXES


class _Helio(typer.Typer):
    """An application whose commands are all checked by `door.Command`."""

    def command(self, name: str | None = None, **options: Any) -> Any:
        def register(function: Any) -> Any:
            COMMANDS.register(name or function.__name__.replace("_", "-"), function, options)
            return function

        return register


app = _Helio(
    cls=Group,
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # plain help: rich alone takes 0.4 s to import
)


def _show_version(wanted: bool) -> None:
    """Print the version and end, if that is wanted."""
    if wanted:
        print(f"helio_jax {__version__}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Simulate scanning helium micrographs and turn three or more of them into a true-to-scale height map."""
    from helio_jax.workflows.compilation_cache import keep_compiled

    keep_compiled()


SceneArg = Annotated[
    Path,
    typer.Argument(help="Scene file (TOML), or a name that helio scenes lists.", metavar="SCENE"),
    Reads(names_files=True),
]
HDF5 = Writes("HDF5", HDF5_SUFFIXES)
"""Mark of what is written as HDF5."""
HTML = Writes("HTML", (".html", ".htm"), beside=(".png",))
"""Mark of a report, beside which its panel is written."""
FIGURE = Writes("a figure", (".png", ".pdf", ".svg"))
"""Mark of options that name a picture to write."""
CSV = Writes("a table", (".csv",))
"""Mark of options that name a table to write."""
TOML = Writes("TOML", (".toml",))
"""Mark of options that name a scene or instrument file to write."""
COLUMNS = Writes("a table", (".csv", ".npz"))
"""Mark of options that name a table of columns to write."""
PICTURE = ".show.png"
"""End of the name of the picture that is written beside micrographs."""
H5WithPicture = Annotated[
    Path,
    typer.Option("--output", "-o", help="File to write (.h5); a picture goes beside it."),
    Writes("HDF5", HDF5_SUFFIXES, picture=PICTURE),
]
Picture = Annotated[bool, typer.Option("--picture/--no-picture", help="Write FILE.show.png beside the file.")]
H5File = Annotated[Path, typer.Option("--output", "-o", help="File to write (.h5)."), HDF5]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Rays = Annotated[int | None, typer.Option(min=8, help="Beam rays per pixel (default: the scene's).")]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Another value: scan.nx=41, sample.rotate_deg=[0,0,9] (repeat)."),
]
Seed = Annotated[int | None, typer.Option(min=0, help="Seed of the tracer (default: the scene's).")]
Workers = Annotated[int | None, typer.Option(min=1, help="Threads, or processes (default: all CPUs).")]
Processes = Annotated[bool, typer.Option("--processes", help="Let the workers be processes instead of threads.")]
Scheduler = Annotated[str | None, typer.Option(help="Address of a dask scheduler whose workers trace (tcp://...).")]
Restart = Annotated[bool, typer.Option("--restart", help="Discard what an unfinished run left, and start afresh.")]
Method = Annotated[str | None, typer.Option(help="linear, nearfield or refine (default: the scene's, or refine).")]

Strict = Annotated[bool, typer.Option("--strict", help="Exit code 4 if the data contradict the height map.")]


def say(message: str) -> None:
    """Print a message to stderr, with --quiet only a warning; and add it to the log."""
    log(message, message.startswith("warning"))
    if not is_quiet.get() or message.startswith("warning"):
        print(message, file=sys.stderr, flush=True)


def warn(trust: dict[str, Any], strict: bool = False) -> None:
    """Print the warnings of a height map (`Reconstruction.trust`); with `strict`, a contradicted one ends the command.

    Raises:
        GuardError: with `strict`, if the data contradict the map.
    """
    from helio_jax.errors import GuardError

    for text in trust["warnings"]:
        say(f"warning: {text}")
    if trust["is_contradicted"] and strict:
        raise GuardError("the data contradict the height map (--strict): it is written, see its status")


def tell_micrographs(stack: Any, output: Path, has_picture: bool, as_json: bool) -> None:
    """Draw what was written beside the file, and print it in about ten lines or as JSON."""
    from helio_jax.figures.summary import summarise, text_lines

    picture = output.with_suffix(PICTURE) if has_picture else None
    if picture:
        from helio_jax.workflows.show import show

        show(stack, picture)
    if as_json:
        print(json.dumps(describe(output) | {"picture": picture and str(picture)}))
        return
    print("\n".join(text_lines(summarise(stack))))
    if picture:
        print(f"picture: {picture}")


LINE_SECONDS = 30.0
"""Time between two lines about the progress, where there is no terminal [s]."""


class Bar:
    """A progress bar on a terminal; elsewhere one line per stage, and one every half a minute."""

    def __init__(self, label: str) -> None:
        self.label = label
        self.bar: Any = None
        self.start = self.said = time.monotonic()
        say(label) if not sys.stderr.isatty() else None

    def __enter__(self) -> "Bar":
        if sys.stderr.isatty() and not is_quiet.get():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

            columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
            self.bar = Progress(*columns, console=Console(stderr=True))
            self.bar.start()
            self.task = self.bar.add_task(self.label, total=None)
        return self

    def __exit__(self, *_: Any) -> None:
        if self.bar:
            self.bar.stop()

    def __call__(self, done: int, total: int, note: str = "") -> None:
        if self.bar:
            self.bar.update(self.task, completed=done, total=total, description=f"{self.label} {note}".strip())
        elif note:
            say(f"  {self.label}: round {done + 1} of {total}, {note}")
        elif 0 < done < total and time.monotonic() - self.said > LINE_SECONDS:
            from helio_jax.figures.wording import duration

            self.said = time.monotonic()
            left = (self.said - self.start) * (total - done) / done
            say(f"  {self.label}: {done / total:.0%} done, about {duration(left)} left")


def print_result(as_json: bool, record: Any, *lines: str) -> None:
    """Print a JSON-compatible record with --json, else lines, if there are any."""
    if as_json:
        print(json.dumps(record))
    elif lines:
        print("\n".join(lines))


def describe(path: Path) -> dict[str, Any]:
    """Return what `helio info --json` prints of a file that was just written."""
    from helio_jax.workflows.file_info import file_info

    return file_info(path).as_dict()


def print_table(rows: list[tuple[str, str, str]]) -> None:
    width = max(len(label) for label, _, _ in rows)
    for label, value, unit in rows:
        print(f"  {label:<{width}}  {value:>10} {unit}")


def set_options(items: list[str] | None, **options: Any) -> dict[str, Any]:
    """Merge settings given as KEY=VALUE (`--set`) with given options.

    Raises:
        SceneError: an item is no KEY=VALUE, or a key is given twice.
    """
    from helio_jax.errors import SceneError

    out = given_options(**options)
    for item in items or ():
        key, is_pair, value = item.partition("=")
        if not is_pair or not key:
            raise SceneError(f"--set {item}: give it as KEY=VALUE")
        if key in out:
            raise SceneError(f"--set {item}: {key} is given already: give it once")
        out[key] = value
    return out


def scene_overrides(items: list[str] | None, **options: Any) -> dict[str, Any]:
    """Merge values of a scene given as KEY=VALUE (`--set`), VALUE as in TOML or a word, with given options.

    Raises:
        SceneError: as `set_options`.
    """
    from helio_jax.texts import parse_value

    given = given_options(**options)
    return {k: v if k in given else parse_value(v) for k, v in set_options(items, **options).items()}


def given_options(**values: Any) -> dict[str, Any]:
    """Return the options that were given."""
    return {key: value for key, value in values.items() if value is not None}
