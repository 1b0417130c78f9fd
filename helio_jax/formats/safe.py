"""Safe reading of files that may be corrupt, and atomic writing.

Parsers written in C crash on corrupt files (SciPy's .mat reader and the HDF5 library do). Foreign bytes are therefore
parsed in a fresh Python process with limited memory and time, which returns arrays and JSON only (no pickle). This
protects against accidents; it is no sandbox against an attacker. No format library is imported here, so that the child
starts quickly.
"""

import contextlib
import importlib
import json
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.errors import InputFileError, MissingDependencyError, SceneError

MIB = 1024**2
GIB = 1024**3
MAX_NAME_BYTES = 230
"""Longest name of an output; most disks take 255, and what is written first adds to it (.part)."""

_BOOT = (
    "import sys; root = sys.argv[1]; root in sys.path or sys.path.insert(0, root); "
    "from helio_jax.formats import safe; safe.serve_request(sys.argv[2])"
)


def make_folder(folder: Path) -> None:
    """Create a folder for output, and those above it.

    Raises:
        SceneError: it cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise SceneError(f"output folder {folder} cannot be made: {e.strerror}; choose another with -o") from None


def check_size(path: str | os.PathLike, limit_bytes: int) -> int:
    """Return the size of a regular, non-empty file of at most `limit_bytes`.

    Raises:
        InputFileError: missing, unreadable, not a regular file, empty, or too large.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        with path.open("rb") if path.is_file() else contextlib.nullcontext():
            pass
    except FileNotFoundError:
        raise InputFileError(f"{path} does not exist: check the name") from None
    except (OSError, ValueError) as e:
        raise InputFileError(f"{path} cannot be opened: {getattr(e, 'strerror', None) or e}") from None
    if not path.is_file():
        raise InputFileError(f"{path} must be a regular file, got a folder or device")
    if size == 0:
        raise InputFileError(f"{path} is empty (0 bytes): fetch or write it again")
    if size > limit_bytes:
        raise InputFileError(
            f"{path} must be at most {limit_bytes / MIB:.0f} MiB, got {size / MIB:.0f} MiB: split it, "
            "or raise the limit if you trust it"
        )
    return size


def call_in_child(
    function_qualname: str, path: str | os.PathLike, *args: Any, memory_bytes: int = 2 * GIB, seconds: float = 120
) -> Any:
    """Call a module-level function of helio_jax on a file in a fresh process with limited memory and time.

    Works from a REPL, pytest or an unguarded script: the child never imports the caller's main module. Memory and
    CPU limits need POSIX (macOS ignores the memory limit; Windows has neither); the wall-clock limit always holds.

    Args:
        function_qualname: "helio_jax.package.module:function"; it is called as function(path, *args).
        path: the file to parse.
        args: JSON-compatible further arguments.
        memory_bytes: limit of the child's address space and of the files it writes.
        seconds: limit of its CPU time; the wall-clock limit is 2 * seconds + 10 s.

    Returns:
        The function's result: nested dicts and lists of numpy arrays and JSON values (tuples become lists).

    Raises:
        InputFileError: the function failed, crashed, took too long or needed too much memory.
        MissingDependencyError: a package that the function needs is not installed.
    """
    with tempfile.TemporaryDirectory(prefix="helio-") as folder:
        request = {
            "function": function_qualname,
            "path": str(Path(path).absolute()),
            "shown": str(path),
            "args": args,
            "memory_bytes": int(memory_bytes),
            "seconds": float(seconds),
            "folder": folder,
        }
        code = _run_child(request, 2 * seconds + 10)
        errors = _tail(Path(folder, "stderr.txt"))
        answer = Path(folder, "answer.json")
        reply = json.loads(answer.read_text("utf-8")) if code == 0 and answer.is_file() else None
        if reply is None:
            what = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
            raise InputFileError(
                f"{path} cannot be read: the reader {what}; the file is corrupt, or needs more than {seconds:g} s or "
                f"{memory_bytes / MIB:.0f} MiB{': ' + errors if errors else ''}"
            )
        if "missing" in reply:
            raise MissingDependencyError(f"reading {path} needs a package that is not installed: {reply['missing']}")
        if "error" in reply:
            raise InputFileError(reply["error"])
        with np.load(Path(folder, "arrays.npz"), allow_pickle=False) as arrays:
            return _unpack(reply["value"], arrays)


def _run_child(request: dict[str, Any], wall_seconds: float) -> int:
    """Run the request in a new interpreter and return its exit status."""
    folder = Path(request["folder"])
    root = str(Path(__file__).resolve().parents[2])
    # -P: no module is imported from the working folder, where the foreign file may lie
    command = [sys.executable, "-P", "-c", _BOOT, root, json.dumps(request)]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    with (folder / "stderr.txt").open("wb") as log:
        try:
            done = subprocess.run(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment, timeout=wall_seconds
            )
        except subprocess.TimeoutExpired:
            raise InputFileError(
                f"{request['shown']} cannot be read: the reader was stopped after {wall_seconds:g} s; the file is "
                "corrupt or too large"
            ) from None
    return done.returncode


def serve_request(text: str) -> None:
    """Answer one request of `call_in_child`; runs in the child only."""
    request = json.loads(text)
    folder, path = Path(request["folder"]), request["shown"]
    _limit_self(request["memory_bytes"], request["seconds"])
    arrays: dict[str, np.ndarray] = {}
    try:
        module, _, name = request["function"].partition(":")
        if not module.startswith("helio_jax."):
            raise ValueError(f"only functions of helio_jax can be called, got {module}")
        value = getattr(importlib.import_module(module), name)(Path(request["path"]), *request["args"])
        reply = {"value": _pack(value, arrays)}
        np.savez(folder / "arrays.npz", **arrays)  # type: ignore[arg-type]
    except ImportError as e:
        reply = {"missing": str(e)}
    except InputFileError as e:
        reply = {"error": str(e).replace(request["path"], path)}
    except MemoryError:
        limit = request["memory_bytes"] / MIB
        reply = {"error": f"{path} cannot be read: it needs more than {limit:.0f} MiB; it is corrupt or too large"}
    except Exception as e:  # any failure of a parser on foreign bytes is a verdict on the file
        reply = {"error": f"{path} cannot be read, it is corrupt or not of this kind: {type(e).__name__}: {e}"[:1000]}
    (folder / "answer.json").write_text(json.dumps(reply), "utf-8")


def _limit_self(memory_bytes: int, seconds: float) -> None:
    """Limit this process's memory, CPU time and file sizes, if the system supports it."""
    try:
        import resource
    except ImportError:  # Windows
        return
    cpu = int(seconds) + 1
    caps = (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_CPU, cpu),
        (resource.RLIMIT_FSIZE, memory_bytes),
        (resource.RLIMIT_AS, memory_bytes),
    )
    for kind, cap in caps:
        hard = resource.getrlimit(kind)[1]
        cap = cap if hard == resource.RLIM_INFINITY else min(cap, hard)
        with contextlib.suppress(ValueError, OSError):  # macOS refuses RLIMIT_AS; the wall clock still holds
            resource.setrlimit(kind, (cap, hard))


def _tail(path: Path) -> str:
    """Return the last line of a log, at most 300 characters."""
    lines = path.read_bytes()[-4000:].decode("utf-8", "replace").strip().splitlines() if path.is_file() else []
    return lines[-1][:300] if lines else ""


def _pack(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Convert a tree to JSON and move its arrays to `arrays`; tags distinguish dicts from arrays."""
    if isinstance(value, dict):
        return {"dict": {str(k): _pack(v, arrays) for k, v in value.items()}}
    if isinstance(value, (list, tuple)):
        return [_pack(v, arrays) for v in value]
    if isinstance(value, np.generic):
        return _pack(value.item(), arrays)
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError("an array of objects cannot be passed on")
        key = f"a{len(arrays)}"
        arrays[key] = value
        return {"array": key}
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"a {type(value).__name__} cannot be passed on")


def _unpack(value: Any, arrays: Any) -> Any:
    """Undo `_pack`."""
    if isinstance(value, list):
        return [_unpack(v, arrays) for v in value]
    if not isinstance(value, dict):
        return value
    if "array" in value:
        return arrays[value["array"]]
    return {k: _unpack(v, arrays) for k, v in value["dict"].items()}


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
