"""Limited child processes that parse untrusted files.

Parsers written in C crash on corrupt files (SciPy's .mat reader and the HDF5 library do), others need any amount of
memory or time. Foreign bytes are therefore parsed in a fresh Python process with limited memory and time, which returns
arrays and JSON only (no pickle). This protects against accidents; it is no sandbox against an attacker. No format
library is imported here, so that the child starts quickly.
"""

import contextlib
import importlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from helio_jax.errors import InputFileError, MissingDependencyError

MIB = 1024**2
GIB = 1024**3
UNPACKED_BYTES = 64 * MIB
UNPACKED_RATIO = 100
"""Largest content of a packed file: these bytes and so many times the file (noise is packed by less than ten)."""
_BOOT = (
    "import sys; root = sys.argv[1]; root in sys.path or sys.path.insert(0, root); "
    "from helio_jax import child; child.serve_request(sys.argv[2])"
)


def check_unpacked(path: str | os.PathLike, n_bytes: float, what: str) -> None:
    """Refuse packed content that is far larger than its file: a few kilobytes must not fill the memory.

    Args:
        path: the file, as large as its data were packed.
        n_bytes: size of the content in memory; at most 64 MiB and 100 times the file.
        what: the content, for the message.

    Raises:
        InputFileError: it is larger.
    """
    size = os.path.getsize(path)
    if n_bytes > (limit := UNPACKED_BYTES + UNPACKED_RATIO * size):
        raise InputFileError(
            f"{path}: {what} must take at most {limit / MIB:.0f} MiB ({UNPACKED_BYTES // MIB} MiB and "
            f"{UNPACKED_RATIO} times the file), it takes {n_bytes / MIB:.0f} MiB: the file is corrupt or was never "
            "filled; write it again without compression"
        )


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
    function_qualname: str,
    path: str | os.PathLike,
    *args: Any,
    memory_bytes: int | None = None,
    seconds: float | None = None,
) -> Any:
    """Call a module-level function of helio_jax on a file in a fresh process with limited memory and time.

    Works from a REPL, pytest or an unguarded script: the child never imports the caller's main module. Memory and
    CPU limits need POSIX (macOS ignores the memory limit; Windows has neither); the wall-clock limit always holds.

    Args:
        function_qualname: "helio_jax.package.module:function"; it is called as function(path, *args).
        path: the file to parse.
        args: JSON-compatible further arguments.
        memory_bytes: limit of the child's address space and of the files it writes; default: 1 GiB and 32 times the
            file, so that a small file cannot take more.
        seconds: limit of its CPU time; default: 10 s and 1 s per MB. The wall-clock limit is 10 * seconds + 60 s: on a
            busy machine a sound file takes long.

    Returns:
        The function's result: nested dicts and lists of numpy arrays and JSON values (tuples become lists).

    Raises:
        InputFileError: the function failed, crashed, took too long or needed too much memory.
        MissingDependencyError: a package that the function needs is not installed.
    """
    size = os.path.getsize(path) if os.path.exists(path) else 0
    memory_bytes = GIB + 32 * size if memory_bytes is None else memory_bytes
    seconds = 10.0 + size / 1e6 if seconds is None else seconds
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
        code = _run_child(request, 10 * seconds + 60)
        errors = _tail(Path(folder, "stderr.txt"))
        answer = Path(folder, "answer.json")
        reply = json.loads(answer.read_text("utf-8")) if code == 0 and answer.is_file() else None
        if reply is None:
            what = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
            raise InputFileError(
                f"{path} cannot be read: the reader {what}; the file is corrupt, or needs more than {seconds:g} s or "
                f"{memory_bytes / MIB:.0f} MiB{': ' + errors if errors else ''}"
            )
        check_reply(path, reply)
        with np.load(Path(folder, "arrays.npz"), allow_pickle=False) as arrays:
            return _unpack(reply["value"], arrays)


def check_reply(path: str | os.PathLike, reply: dict[str, Any]) -> None:
    """Raise what `answer` caught.

    Raises:
        InputFileError, MissingDependencyError: as `call_in_child`.
    """
    if "missing" in reply:
        raise MissingDependencyError(f"reading {path} needs a package that is not installed: {reply['missing']}")
    if "error" in reply:
        raise InputFileError(reply["error"])


def _run_child(request: dict[str, Any], wall_seconds: float) -> int:
    """Run the request in a new interpreter and return its exit status."""
    folder = Path(request["folder"])
    root = str(Path(__file__).resolve().parents[1])
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
    _limit_self(request["memory_bytes"], request["seconds"])
    serve(request)


def serve(request: dict[str, Any]) -> None:
    """Call the function of a request and write reply and arrays into its folder."""
    folder, path = Path(request["folder"]), request["shown"]
    arrays: dict[str, np.ndarray] = {}
    reply = answer(request, arrays)
    if "value" in reply:
        try:
            np.savez(folder / "arrays.npz", **arrays)  # type: ignore[arg-type]
        except OSError as e:
            reply = {"error": f"{path} cannot be read: its content cannot be kept in {folder}: {e.strerror or e}"}
    (folder / "answer.json").write_text(json.dumps(reply), "utf-8")


def answer(request: dict[str, Any], arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Call the function of a request; return the reply, any failure as its text, and add the arrays to `arrays`."""
    path = request["shown"]
    try:
        module, _, name = request["function"].partition(":")
        if not module.startswith("helio_jax."):
            raise ValueError(f"only functions of helio_jax can be called, got {module}")
        value = getattr(importlib.import_module(module), name)(Path(request["path"]), *request["args"])
        return {"value": _pack(value, arrays)}
    except ImportError as e:
        return {"missing": str(e)}
    except InputFileError as e:
        return {"error": str(e).replace(request["path"], path)}
    except MemoryError:
        limit = request["memory_bytes"] / MIB
        return {"error": f"{path} cannot be read: it needs more than {limit:.0f} MiB; it is corrupt or too large"}
    except Exception as e:  # any failure of a parser on foreign bytes is a verdict on the file
        return {"error": f"{path} cannot be read, it is corrupt or not of this kind: {type(e).__name__}: {e}"[:1000]}


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
