"""Scenes, instruments and studies that come with the program, found by name.

They stand in one place, `scenes/` of the repository; a wheel holds that folder inside the package (pyproject.toml).
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from helio_jax.errors import SceneError
from helio_jax.spelling import did_you_mean

Kind = Literal["scene", "instrument", "study"]
"""What a file describes; a scene contains an instrument, a study varies a scene."""
ALIASES = {"bshem": "bshem_wd3", "ashem": "ashem_normal"}
"""Short names of the instruments that measured scans come from."""


@dataclass(frozen=True)
class Shipped:
    """One file that comes with the program."""

    name: str
    kind: Kind
    path: Path

    @property
    def aliases(self) -> tuple[str, ...]:
        """Other names of it."""
        return tuple(alias for alias, name in ALIASES.items() if name == self.name)

    @property
    def about(self) -> str:
        """First line of the file's first comment."""
        with self.path.open(encoding="utf-8") as lines:
            return next(lines).removeprefix("#").strip()


def shipped_folder() -> Path:
    """Return the folder of the shipped scenes: inside an installed package, beside it in a clone."""
    package = Path(__file__).resolve().parents[1]
    inside = package / "scenes"
    return inside if inside.is_dir() else package.parent / "scenes"


def list_shipped() -> tuple[Shipped, ...]:
    """List the scenes, then the instruments, then the studies, each by name."""
    kinds: dict[Kind, str] = {"scene": "*.toml", "instrument": "instruments/*.toml", "study": "studies/*.toml"}
    folder = shipped_folder()
    return tuple(Shipped(p.stem, kind, p) for kind, pattern in kinds.items() for p in sorted(folder.glob(pattern)))


def find_shipped(name: str) -> Shipped:
    """Return the scene, instrument or study of a name.

    Raises:
        SceneError: there is none; the message names the nearest.
    """
    files = {file.name: file for file in list_shipped()}
    if found := files.get(ALIASES.get(name, name)):
        return found
    question = did_you_mean(name, [*files, *ALIASES], most=3) or "choose another name"
    raise SceneError(
        f"no scene, instrument or study called {name!r} comes with helio: {question} (helio scenes lists all)"
    )


def locate(name: str | os.PathLike, folder: Path = Path()) -> Path:
    """Return the path of a scene, instrument or study that is given by its path or by its name.

    A file that is there always wins. A name has neither a folder nor a suffix; it is looked up among those that come
    with the program.

    Args:
        name: path, relative to `folder`; or name.
        folder: where relative paths start.

    Raises:
        SceneError: an unknown name; or no such file, where one of this name comes with the program.
    """
    path, plain = folder / name, Path(name)
    is_name = plain.name == os.fspath(name) and not plain.suffix
    is_folder = os.path.isdir(path)
    if os.path.exists(path) and not (is_name and is_folder):
        return path
    if is_name:
        try:
            return find_shipped(plain.name).path
        except SceneError as e:
            wrong = "is a folder" if is_folder else f"no such file (looked in {folder.resolve()})"
            raise SceneError(f"{path}: {wrong}; {e}") from None
    if plain.suffix == ".toml" and plain.stem in {file.name for file in list_shipped()}:
        raise SceneError(
            f"{path}: no such file (looked in {path.parent.resolve()}); {plain.stem!r}, without folder and suffix, "
            "names the file that comes with helio"
        )
    return path


def path_beside(name: str | os.PathLike, suffix: str) -> Path:
    """Return the path of what is written beside a file, under its name with another suffix.

    What comes with the program stays as it is: beside its files nothing is written, but in the current folder.

    Raises:
        SceneError: see `locate`.
    """
    path = Path(name)
    is_shipped = locate(path).resolve() in {file.path.resolve() for file in list_shipped()}
    return (Path() if is_shipped else path.parent) / f"{path.stem}{suffix}"
