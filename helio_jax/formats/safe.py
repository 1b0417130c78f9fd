"""Checks of outputs before any work, and atomic writing. Reading of untrusted files: `helio_jax.child`."""

import contextlib
import os
import secrets
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from helio_jax.errors import SceneError

MAX_NAME_BYTES = 230
"""Longest name of an output; most disks take 255, and what is written first adds to it (.part)."""


def make_folder(folder: Path) -> None:
    """Create a folder for output, and those above it.

    Raises:
        SceneError: it cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise SceneError(f"output folder {folder} cannot be made: {e.strerror}; choose another with -o") from None


def check_target(target: Path) -> Path:
    """Return the file that writing to `target` will replace; links are followed.

    Raises:
        SceneError: it is a folder, a device or write-protected, or its folder does not exist.
    """
    try:
        real = target.resolve()
        is_there, is_file, has_folder = real.exists(), real.is_file(), real.parent.is_dir()
    except (OSError, RuntimeError) as e:  # a name that is too long, a loop of links
        raise SceneError(f"cannot write {target}: {getattr(e, 'strerror', None) or e}; name another file") from None
    if is_there and not is_file:
        raise SceneError(f"cannot write {target}: it is a folder or device; name a file")
    if is_there and not (os.access(real, os.W_OK) and real.stat().st_mode & 0o222):  # root may write what is protected
        raise SceneError(f"cannot write {target}: it is write-protected; name another file or allow writing")
    if not has_folder:
        raise SceneError(f"cannot write {target}: No such file or directory; check the folder, rights and space")
    return real


def check_new(path: Path) -> None:
    """Refuse a file that exists.

    Raises:
        SceneError: it does.
    """
    if os.path.lexists(path):
        raise SceneError(f"{path} exists and is kept: choose another place, or replace it with --force")


def check_outputs(inputs: Iterable[tuple[str, Path]], outputs: Iterable[tuple[str, Path]]) -> None:
    """Refuse, before any work, outputs that are an input, that are one file, or that could not be written.

    Files are compared by identity, not by name, symbolic and hard links included.

    Args:
        inputs: of every file that is read, what names it (an option) and its path.
        outputs: the same of every file that will be written.

    Raises:
        SceneError: the message names the file, what names it twice, and the remedy.
    """
    outputs, inputs = list(outputs), list(inputs)
    for name, path in outputs:
        for source, read in inputs:
            if _is_same(path, read):
                raise SceneError(
                    f"{path} ({name}) is the same file as {read} ({source}), which is read and would be lost: name "
                    f"another file with {name.partition(':')[0]}"
                )
    for i, (name, path) in enumerate(outputs):
        for other, before in outputs[:i]:
            if _is_same(path, before):
                raise SceneError(f"{path} ({name}) and {before} ({other}) are one file: give them two names")
    for name, path in outputs:
        try:
            real = check_target(path)
            if (n_bytes := len(os.fsencode(real.name))) > MAX_NAME_BYTES:
                limit = f"the limit is {MAX_NAME_BYTES}: shorten it"
                raise SceneError(f"cannot write {path}: its name has {n_bytes} bytes, {limit}")
            _check_folder(real.parent, path)
        except SceneError as e:
            raise SceneError(f"{name}: {e}") from None


def files_within(name: str, folder: Path, files: Iterable[str]) -> list[tuple[str, Path]]:
    """Return, for `check_outputs`, the files that will be written in a folder that may have to be made first.

    Raises:
        SceneError: the folder cannot be made, or nothing can be written in it.
    """
    try:
        is_there = folder.exists()
        above = next(p for p in (folder, *folder.absolute().parents) if p.exists())
        if not above.is_dir():
            raise SceneError(f"cannot write {folder}: {above} is a file; name a folder")
        _check_folder(above, folder)
    except OSError as e:  # a name that is too long
        raise SceneError(f"{name}: cannot write {folder}: {e.strerror}; name another folder") from None
    except SceneError as e:
        raise SceneError(f"{name}: {e}") from None
    return [(f"{name}: its {file}", folder / file) for file in files] if is_there else []


def _check_folder(folder: Path, what: Path) -> None:
    """Refuse a folder in which nothing can be made (rights, a read-only disk), as the system sees it."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as e:
        raise SceneError(f"cannot write {what}: {e.strerror or e}; check the folder, rights and space") from None


def _is_same(path: Path, other: Path) -> bool:
    """Whether two paths lead to one file, or would if it were there."""
    try:
        path, other = path.resolve(), other.resolve()
        if path.exists() and other.exists():
            return os.path.samefile(path, other)
        return path.name == other.name and os.path.samefile(path.parent, other.parent)
    except (OSError, RuntimeError):  # reported by whoever reads or writes it
        return False


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path in the same folder that becomes `path` when the block succeeds.

    The temporary file keeps the suffix. It is flushed to disk before it replaces the target in one step. If the block
    fails, it is removed and an existing target is unchanged.

    Raises:
        SceneError: the target cannot be written (no such folder, no permission, disk full, is a folder).
    """
    target = Path(path)
    temporary: Path | None = None
    try:
        real = check_target(target)
        temporary = real.with_name(f".{real.stem[:80]}.{secrets.token_hex(4)}.part{real.suffix}")
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
        yield temporary
        _flush(temporary)
        if real.exists():
            shutil.copymode(real, temporary)
        os.replace(temporary, real)
        with contextlib.suppress(OSError):  # some network file systems cannot flush a folder
            _flush(real.parent)
    except OSError as e:
        raise SceneError(f"cannot write {target}: {e.strerror or e}; check the folder, rights and space") from e
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    """Flush a file to disk, or a folder on POSIX systems."""
    if path.is_dir() and os.name != "posix":
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
