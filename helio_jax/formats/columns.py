"""Write tables of named columns as text (.csv) or NumPy arrays (.npz)."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from helio_jax.errors import SceneError
from helio_jax.formats.safe import atomic_path, check_target


def check_table_target(path: str | os.PathLike) -> str:
    """Return the suffix of a table to be written; call this before a long computation.

    Raises:
        SceneError: the suffix is neither .csv nor .npz, or the file cannot be written there.
    """
    kind = Path(path).suffix.lower()
    if kind not in (".csv", ".npz"):
        raise SceneError(f"{path}: a table is written as .csv or .npz, got {kind or 'no suffix'!r}")
    check_target(Path(path))
    return kind


def write_columns(path: str | os.PathLike, columns: Mapping[str, np.ndarray]) -> None:
    """Write columns of equal length; numbers in text are exact (17 digits).

    Raises:
        SceneError: as `check_table_target`.
    """
    kind = check_table_target(path)
    with atomic_path(path) as part:
        if kind == ".npz":
            np.savez_compressed(part, **columns)  # type: ignore[arg-type]
            return
        texts = [c.astype(str) if c.dtype.kind in "iuSU" else np.char.mod("%.17g", c) for c in columns.values()]
        with part.open("w", encoding="utf-8", newline="\n") as file:
            file.write(",".join(columns) + "\n")
            file.writelines(",".join(row) + "\n" for row in zip(*texts, strict=True))
