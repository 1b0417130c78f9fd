"""Partial results of a long run, kept in the folder OUT.parts beside OUT until the run is complete.

A manifest (JSON) identifies the run. Every part is an uncompressed .npz (with checksums), renamed into place in one
step. Parts are untrusted like any other file: bounded, no pickle, every failure names the file.
"""

import contextlib
import io
import json
import os
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.child import GIB, MIB, check_size
from helio_jax.errors import InputFileError, SceneError
from helio_jax.formats import safe
from helio_jax.texts import parse_json

MAX_PART_BYTES = GIB
MAX_MANIFEST_BYTES = 16 * MIB
_OWN = re.compile(r"claimed|\d{6}\.npz|whole\.\w+|\.(\d{6}|manifest|whole)\.[0-9a-f]{8}\.part\.\w+")
"""Names that parts have, finished or not."""


class Parts:
    """The parts of one output file."""

    def __init__(self, output: Path) -> None:
        self.output = output
        self.folder = output.with_name(output.name + ".parts")

    @property
    def exist(self) -> bool:
        """Whether an unfinished run exists."""
        return (self.folder / "manifest.json").is_file()

    def begin(self, manifest: dict[str, Any]) -> None:
        """Create the folder and its manifest.

        Raises:
            SceneError: the folder or the output file cannot be written.
        """
        safe.check_target(self.output)
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as e:
            raise SceneError(f"cannot make {self.folder}: {e.strerror}; check the folder, rights and space") from None
        with safe.atomic_path(self.folder / "manifest.json") as path:
            path.write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")

    def manifest(self) -> dict[str, Any]:
        """Read the manifest.

        Raises:
            InputFileError: missing or damaged.
        """
        path = self.folder / "manifest.json"
        check_size(path, MAX_MANIFEST_BYTES)
        try:
            found = parse_json(path.read_text(encoding="utf-8"))
        except ValueError as e:
            raise InputFileError(f"{path} is damaged ({e}): remove {self.folder} and start again") from None
        if not isinstance(found, dict):
            raise InputFileError(f"{path} must hold one JSON object: remove {self.folder} and start again")
        return found

    def path(self, number: int) -> Path:
        """Return the path of a part."""
        return self.folder / f"{number:06d}.npz"

    def has(self, number: int) -> bool:
        """Whether a part exists (intact or not)."""
        return self.path(number).is_file()

    def save(self, number: int, arrays: dict[str, np.ndarray]) -> None:
        """Store one part, in one step.

        Raises:
            SceneError: it cannot be written.
        """
        with safe.atomic_path(self.path(number)) as path:
            np.savez(path, **arrays)  # type: ignore[arg-type]

    def load(self, number: int) -> dict[str, np.ndarray]:
        """Read one part.

        Raises:
            InputFileError: missing, too large or damaged.
        """
        path = self.path(number)
        check_size(path, MAX_PART_BYTES)
        try:
            data = path.read_bytes()
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
                    raise ValueError("it is compressed")
            with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
        except Exception as e:  # zipfile and numpy raise many kinds on corrupt files
            raise InputFileError(f"{path} is damaged ({type(e).__name__}: {e})") from None

    def claim(self, owner: str) -> bool:
        """Claim the merge of the complete parts; True for one of all concurrent owners.

        An owner that claimed it before gets it again: it was killed, and its command is repeated.
        """
        path = self.folder / "claimed"
        try:
            with path.open("x", encoding="utf-8") as file:
                file.write(owner)
            return True
        except FileExistsError:
            with contextlib.suppress(OSError):  # merged and removed meanwhile
                return path.read_text(encoding="utf-8") in ("", owner)
        except FileNotFoundError:  # merged and removed already
            pass
        return False

    def claimed_by(self) -> str:
        """Return the owner of the merge; "" if there is none any more."""
        try:
            return (self.folder / "claimed").read_text(encoding="utf-8")
        except OSError:
            return ""

    def finish(self, write: Callable[[Path], None]) -> None:
        """Write the complete file, and remove the parts.

        The file is written in the folder and then moved, so that a killed process leaves nothing outside the folder.

        Args:
            write: writes the file to a given path.

        Raises:
            SceneError: the file cannot be written.
        """
        if not self.exist:
            write(self.output)
            return
        whole = self.folder / f"whole{self.output.suffix}"
        write(whole)
        try:
            os.replace(whole, safe.check_target(self.output))
        except OSError as e:
            raise SceneError(f"cannot write {self.output}: {e.strerror}; check the folder and its rights") from None
        self.remove()

    def remove(self) -> None:
        """Remove the parts and what a killed process left of them, the manifest first, and the folder once it is empty.

        An interrupted removal leaves no unfinished run. Files of others stay.
        """
        with contextlib.suppress(FileNotFoundError, NotADirectoryError):
            (self.folder / "manifest.json").unlink(missing_ok=True)
            for path in self.folder.iterdir():
                if _OWN.fullmatch(path.name) and path.is_file():
                    path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # it holds something else, or is gone
            self.folder.rmdir()
