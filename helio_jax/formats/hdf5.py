"""Write and read helio files: HDF5 with a NeXus layout (see `nexus`). The only import of h5py.

The HDF5 library can crash on a corrupt file. Every file is therefore opened in a limited child process, which returns
plain arrays; this costs a Python start (0.7 s on a slow core). `nexus` and the records are imported late to keep that
start short.
Refused: external and soft links, external storage, virtual datasets, unknown filters, objects, oversized data.
"""

import contextlib
import hashlib
import os
import re
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from helio_jax.arguments import checked
from helio_jax.child import GIB, MIB, UNPACKED_BYTES, UNPACKED_RATIO, call_in_child, check_size, check_unpacked
from helio_jax.errors import InputFileError
from helio_jax.formats import safe
from helio_jax.texts import parse_json

if TYPE_CHECKING:
    from helio_jax.formats.nexus import Node, Noun
    from helio_jax.micrograph import Micrographs, MicrographStack
    from helio_jax.reconstruction import Reconstruction

FORMAT = "1.1"
"""1.1: what steers later steps has places of its own; in files of 1.0 it is in the provenance."""
MAX_BYTES = 4 * GIB
_MAX_OBJECTS = 20_000
_MAX_DEPTH = 8
_MAX_LINKS = 8
"""Largest number of names of one object; its own are at most three."""
_MAX_ATTRIBUTE_BYTES = 64 * 1024
_MAX_TEXT_BYTES = 16 * MIB
_FILTERS = (h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32)
_SCAN = re.compile(r"scan_[1-9][0-9]{0,5}")


def write(obj: "Noun", path: str | os.PathLike) -> None:
    """Write a `MicrographStack`, `MicrographSet` or `Reconstruction`, replacing the file in one step.

    Args:
        obj: data to write.
        path: target, usually `.h5`; unchanged if writing fails.

    Raises:
        SceneError: the target cannot be written.
        HelioError: the object is of another kind, or its provenance is not JSON-compatible.

    Example:
        >>> hx.write(rec, "height.h5")
    """
    import helio_jax
    from helio_jax.formats import nexus

    nodes = nexus.lay_out(obj)
    root: dict[str, str | list[str]] = {
        "NX_class": "NXroot",
        "default": "entry",
        "creator": "helio_jax",
        "creator_version": helio_jax.__version__,
        "helio_format": FORMAT,
        "filetype": nexus.KINDS[type(obj)],
        "file_time": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    # v110: the library then stores checksums of its own structures, which reveal damage
    with safe.atomic_path(path) as temporary:
        temporary.write_bytes(_image(root, nodes))


def _image(root: dict[str, str | list[str]], nodes: list["Node"]) -> bytes:
    """Return the bytes of a file; made in memory, for the library crashes if the disk is full when it closes a file."""
    options = {"driver": "core", "backing_store": False, "block_size": 16 * MIB}
    with h5py.File("in memory", "w", libver=("v110", "v110"), **options) as file:
        _put_attributes(file, root)
        for node in nodes:
            _put_node(file, node)
        file.flush()
        return file.id.get_file_image()


def _put_node(file: h5py.File, node: "Node") -> None:
    """Write one group, dataset or alias."""
    if node.same_as is not None:
        file[node.path] = file[node.same_as]
        return
    if node.value is None:
        _put_attributes(file.create_group(node.path), node.attributes)
        return
    value = _fixed_text(node.value) if isinstance(node.value, str) else np.asarray(node.value)
    if value.dtype != np.uint8 and value.dtype.kind != "S":
        value = value.astype("<f8")
    packing = {"compression": "gzip", "compression_opts": 4, "shuffle": True} if value.ndim and value.size else {}
    dataset = file.create_dataset(node.path, data=value, **packing)
    # gzip and the library's own structures have checksums, single values do not
    checksum = {} if value.ndim else {"sha256": hashlib.sha256(value.tobytes()).hexdigest()}
    _put_attributes(dataset, {**node.attributes, **checksum})


def _put_attributes(target: Any, attributes: Mapping[str, str | list[str]]) -> None:
    """Write attributes as texts of fixed length."""
    for name, value in attributes.items():
        target.attrs.create(name, _fixed_text(value))


def _fixed_text(value: str | list[str]) -> np.ndarray:
    """Encode UTF-8 text of fixed length, which other programs handle better than variable length."""
    texts = [v.encode() for v in ([value] if isinstance(value, str) else value)]
    length = max(1, *map(len, texts))
    array = np.array(texts, dtype=h5py.string_dtype("utf-8", length))
    return array[0].reshape(()) if isinstance(value, str) else array


@checked
def read(path: str | os.PathLike, *, max_bytes: int = MAX_BYTES) -> "Noun":
    """Read a helio file.

    Args:
        path: written by `write`, by this or another version with the same major format.
        max_bytes: largest file, and largest sum of all arrays once unpacked.

    Returns:
        `MicrographStack`, `MicrographSet` or `Reconstruction`, equal bit for bit to what was written.

    Raises:
        InputFileError: missing, not HDF5, not a helio file, damaged, too large, or with links to other files.

    Example:
        >>> hx.read("height.h5").height
    """
    from helio_jax.formats import nexus

    found = _load_in_child(path, nexus.READ_PLACES, max_bytes)
    return nexus.rebuild(found["filetype"], found["entries"], str(path), found["helio_format"])


def read_micrographs(path: str | os.PathLike) -> "Micrographs":
    """Read a helio file that must hold micrographs: a stack, or a set of several scans.

    Raises:
        InputFileError: as `read`, or the file holds a height map.
    """
    from helio_jax.reconstruction import Reconstruction

    found = read(path)
    if isinstance(found, Reconstruction):
        raise InputFileError(f"{path}: holds a height map, needed are micrographs: run helio simulate or helio import")
    return found


def read_stack(path: str | os.PathLike) -> "MicrographStack":
    """Read a helio file that must hold one stack: a set of several scans has no common raster.

    Raises:
        InputFileError: as `read_micrographs`, or the file holds several scans.
    """
    found = read_micrographs(path)
    try:
        return found.only()
    except InputFileError as e:
        raise InputFileError(f"{path}: {e}") from None


def read_height(path: str | os.PathLike) -> "Reconstruction":
    """Read a helio file that must hold a height map.

    Raises:
        InputFileError: as `read`, or the file holds micrographs.
    """
    from helio_jax.reconstruction import Reconstruction

    found = read(path)
    if not isinstance(found, Reconstruction):
        raise InputFileError(f"{path}: holds micrographs, needed is a height map: run helio reconstruct")
    return found


def describe(path: str | os.PathLike) -> dict[str, Any]:
    """Summarise a helio file without reading its arrays; the result is JSON-compatible.

    Returns:
        file, bytes, kind, format, creator, created; and per entry ("" or "scan_1", ...): fields (shape, unit and
        long name by path), instrument, calibration, alignment, materials and provenance.

    Raises:
        InputFileError: as `read`.
    """
    from helio_jax.formats import nexus

    return _summary_of(path, _load_in_child(path, nexus.COMMON_PLACES, MAX_BYTES))


def read_described(path: str | os.PathLike) -> tuple["Noun", dict[str, Any]]:
    """Read a helio file once and return what `read` and `describe` return (errors as those)."""
    from helio_jax.formats import nexus

    found = _load_in_child(path, nexus.READ_PLACES, MAX_BYTES)
    about = _summary_of(path, found)
    return nexus.rebuild(found["filetype"], found["entries"], str(path), found["helio_format"]), about


def _summary_of(path: str | os.PathLike, found: dict[str, Any]) -> dict[str, Any]:
    """Summarise what the child has read, for `describe`."""
    from helio_jax.formats import nexus

    entries = {}
    for name, values in found["entries"].items():
        texts = {place: _json(path, name, place, values.get(place, "null")) for place in nexus.COMMON_PLACES}
        entries[name] = {"fields": found["fields"][name]}
        entries[name] |= {place.partition("/")[0]: value for place, value in texts.items()}
    about = {key: found[key] for key in ("filetype", "helio_format", "creator", "creator_version", "file_time")}
    names = {"filetype": "kind", "helio_format": "format", "file_time": "created"}
    about = {names.get(key, key): value for key, value in about.items()}
    return {"file": str(path), "bytes": Path(path).stat().st_size, **about, "entries": entries}


def _json(path: str | os.PathLike, scan: str, place: str, text: Any) -> Any:
    """Parse the JSON text at a place of an entry."""
    try:
        return parse_json(text)
    except (TypeError, ValueError) as e:
        where = "/".join(filter(None, ("/entry", scan, place)))
        raise InputFileError(f"{path}: {where} is not JSON: {e}") from None


def _load_in_child(path: str | os.PathLike, places: tuple[str, ...], max_bytes: int) -> dict[str, Any]:
    """Check the file's size and read it in a child process."""
    check_size(path, max_bytes)
    with Path(path).open("rb") as file:
        head = file.read(8)
    if head != b"\x89HDF\r\n\x1a\n":
        raise InputFileError(f"{path} is not an HDF5 file: its first bytes are {head!r}")
    unpacked = min(max_bytes, UNPACKED_BYTES + UNPACKED_RATIO * Path(path).stat().st_size)
    memory = 2 * unpacked + GIB
    return call_in_child("helio_jax.formats.hdf5:load_fields", path, places, max_bytes, memory_bytes=memory)


def load_fields(path: Path, places: list[str], max_bytes: int) -> dict[str, Any]:
    """Read root attributes, the values at `places` and a summary of all fields; runs in a child process.

    Raises:
        InputFileError: see `read`.
    """
    with _open(path) as file:
        about = _read_about(path, file)
        entries: dict[str, dict[str, Any]] = {}
        fields: dict[str, dict[str, Any]] = {}
        n_bytes = 0
        for place, item in _walk(path, file):
            n_bytes += _check_item(path, place, item)
            if n_bytes > max_bytes:
                raise InputFileError(
                    f"{path}: the arrays up to {place} must take at most {max_bytes / MIB:.0f} MiB, they declare "
                    f"{n_bytes / MIB:.0f} MiB: the file is corrupt, or read it with a larger max_bytes"
                )
            check_unpacked(path, n_bytes, f"the arrays up to {place}")
            scan, _, rest = place.removeprefix("/entry/").partition("/")
            name, inner = (scan, rest) if _SCAN.fullmatch(scan) else ("", place.removeprefix("/entry/"))
            if not isinstance(item, h5py.Dataset):
                continue
            fields.setdefault(name, {})[inner] = _summary(path, place, item)
            target = entries.setdefault(name, {})
            if inner in places:
                target[inner] = _value(path, place, item)
    return {**about, "entries": entries, "fields": fields}


@contextlib.contextmanager
def _open(path: Path) -> Iterator[h5py.File]:
    """Open a file for reading."""
    try:
        file = h5py.File(path, "r", locking=False)
    except OSError as e:
        raise InputFileError(f"{path} is not a readable HDF5 file, it is damaged or of another kind: {e}") from None
    with file:
        yield file


def _read_about(path: Path, file: h5py.File) -> dict[str, str]:
    """Read the root attributes; refuse files of other programs or of another major format."""
    names = ("helio_format", "filetype", "creator", "creator_version", "file_time")
    about = {name: _text_attribute(path, "/", file, name) for name in names}
    if not about["helio_format"]:
        raise InputFileError(f"{path}: / has no attribute helio_format: not a helio file; see `helio import --help`")
    major = about["helio_format"].partition(".")[0]
    if major != FORMAT.partition(".")[0]:
        raise InputFileError(
            f"{path}: helio_format must be {FORMAT.partition('.')[0]}.x, got {about['helio_format']!r}: "
            "update helio_jax (pip install -U helio-jax)"
        )
    return about


def _walk(path: Path, group: h5py.Group, depth: int = 1, count: list[int] | None = None) -> Iterator[tuple[str, Any]]:
    """Yield every object below `group` with its path, following hard links only."""
    count = [0] if count is None else count
    for name in group:
        place = f"{str(group.name).rstrip('/')}/{name}"
        count[0] += 1
        if count[0] > _MAX_OBJECTS or depth > _MAX_DEPTH:
            limit = f"{_MAX_OBJECTS} objects, {_MAX_DEPTH} deep"
            raise InputFileError(f"{path}: at {place} there are more than {limit}: not a helio file, or corrupt")
        link = group.get(name, getlink=True)
        if not isinstance(link, h5py.HardLink):
            kind = {h5py.SoftLink: "a soft", h5py.ExternalLink: "an external"}.get(type(link), "an unknown kind of")
            raise InputFileError(f"{path}: {place} is {kind} link, which is refused: copy the data into the file")
        item = group[name]
        yield place, item
        if isinstance(item, h5py.Group):
            yield from _walk(path, item, depth + 1, count)


def _check_item(path: Path, place: str, item: Any) -> int:
    """Refuse storage outside the file or with plugins; return the size that the item declares [bytes]."""
    if (n_links := h5py.h5o.get_info(item.id).rc) > _MAX_LINKS:
        raise InputFileError(f"{path}: {place} is linked {n_links} times, the limit is {_MAX_LINKS}: not a helio file")
    if isinstance(item, h5py.Group):
        return 0
    if not isinstance(item, h5py.Dataset):
        raise InputFileError(f"{path}: {place} is a {type(item).__name__}, which is refused: not a helio file")
    plan = item.id.get_create_plist()
    if plan.get_external_count():
        raise InputFileError(f"{path}: {place} keeps its data in another file, which is refused: copy it in")
    if item.is_virtual:
        raise InputFileError(f"{path}: {place} is a virtual dataset, which is refused: copy the data in")
    filters = [plan.get_filter(i)[0] for i in range(plan.get_nfilters())]
    if any(f not in _FILTERS for f in filters):
        raise InputFileError(f"{path}: {place} must be compressed with gzip only, got HDF5 filters {filters}")
    if item.dtype.kind not in "fiubS":
        raise InputFileError(f"{path}: {place} must hold numbers or fixed-length text, got {item.dtype}")
    if item.dtype.kind == "S" and item.dtype.itemsize > _MAX_TEXT_BYTES:
        size, limit = item.dtype.itemsize / MIB, _MAX_TEXT_BYTES / MIB
        raise InputFileError(f"{path}: {place} is a text of {size:.0f} MiB, the limit is {limit:.0f} MiB: shorten it")
    if item.shape is None:
        raise InputFileError(f"{path}: {place} is a dataset without data: the file is incomplete")
    return int(item.dtype.itemsize) * int(np.prod([float(n) for n in item.shape]))


def _value(path: Path, place: str, item: h5py.Dataset) -> Any:
    """Read a dataset: text or array."""
    try:
        value = item[()]
    except OSError as e:
        raise InputFileError(f"{path}: {place} cannot be read, the file is damaged: {e}") from None
    value = np.asarray(value)
    digest = _text_attribute(path, place, item, "sha256")
    if digest and hashlib.sha256(value.tobytes()).hexdigest() != digest:
        raise InputFileError(f"{path}: {place} does not match its checksum: the file is damaged")
    if item.dtype.kind != "S":
        return value
    if item.shape != ():
        raise InputFileError(f"{path}: {place} must be one text, got an array of {item.shape}")
    try:
        return bytes(value[()]).decode("utf-8")
    except UnicodeDecodeError as e:
        raise InputFileError(f"{path}: {place} is not UTF-8 text: {e}") from None


def _summary(path: Path, place: str, item: h5py.Dataset) -> dict[str, Any]:
    """Return shape, unit and long name of a dataset."""
    unit, long_name = (_text_attribute(path, place, item, name) for name in ("units", "long_name"))
    return {"shape": list(item.shape), "unit": unit, "long_name": long_name}


def _text_attribute(path: Path, place: str, item: Any, name: str) -> str:
    """Read a text attribute; "" if it is missing."""
    try:
        if name in item.attrs and item.attrs.get_id(name).get_storage_size() > _MAX_ATTRIBUTE_BYTES:
            raise ValueError(f"it has more than {_MAX_ATTRIBUTE_BYTES} bytes")
        value = item.attrs.get(name, "")
    except (OSError, RuntimeError, TypeError, ValueError) as e:
        raise InputFileError(f"{path}: {place}@{name} cannot be read, the file is damaged: {e}") from None
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
