"""Read a file of any kind that holds a record: micrographs, heights, a scene, an instrument."""

import os
from collections.abc import Mapping
from typing import Any

from helio_jax.child import check_size
from helio_jax.errors import InputFileError, SceneError
from helio_jax.formats.hdf5 import MAX_BYTES, read
from helio_jax.formats.matlab import import_micrographs
from helio_jax.formats.suffixes import HDF5_SUFFIXES
from helio_jax.heightmap import HeightMap
from helio_jax.instrument import Instrument
from helio_jax.micrograph import Micrographs
from helio_jax.reconstruction import Reconstruction
from helio_jax.scene.files import read_height_map
from helio_jax.workflows.scene_file import is_scene, load_instrument, load_scene, read_tables
from helio_jax.workflows.shipped import locate

Record = Micrographs | Reconstruction | HeightMap | Instrument
"""What a file can hold; a scene is an instrument, too."""


def read_any(
    path: str | os.PathLike,
    instrument: str | os.PathLike | None = None,
    overrides: Mapping[str, Any] | None = None,
) -> Record:
    """Read a record from a file by its suffix and, of TOML, by its tables.

    Args:
        path: .h5 of helio; .toml of a scene or an instrument, or the name of one that comes with the program; .mat of
            micrographs; .npz of a height map (in um).
        instrument: file or name of the instrument, for a .mat file.
        overrides: values that override a scene or an instrument, dotted keys.

    Raises:
        InputFileError: missing, damaged, or of an unknown kind.
        SceneError: a wrong scene or instrument file, an unknown name, or overrides of another file.
    """
    path = locate(path)
    kind = path.suffix.lower()
    if kind == ".toml":
        return load_scene(path, overrides) if is_scene(read_tables(path)) else load_instrument(path, overrides)
    if overrides:
        raise SceneError(f"{path}: --set {next(iter(overrides))}: only values of a scene or an instrument can be set")
    check_size(path, MAX_BYTES)
    if kind in HDF5_SUFFIXES:
        return read(path)
    if kind == ".mat":
        return import_micrographs(path, None if instrument is None else load_instrument(instrument))
    if kind == ".npz":
        return read_height_map(path, 1.0, None)
    raise InputFileError(
        f"{path}: no record can be read from a {kind or 'file without a suffix'}: known are "
        f"{', '.join(HDF5_SUFFIXES)}, .toml (scene, instrument), .mat (micrographs), .npz (height map); meshes and "
        "tables belong in a scene (helio info says what a file holds)"
    )
