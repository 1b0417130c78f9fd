"""Copy a scene, instrument or study that comes with the program, with every file that it reads."""

from pathlib import Path

from helio_jax.formats.safe import atomic_path, check_new, make_folder
from helio_jax.workflows.scene_file import files_read
from helio_jax.workflows.shipped import find_shipped


def copy_shipped(name: str, folder: Path, *, force: bool = False) -> list[Path]:
    """Copy a shipped file and what it extends; files that are there already, byte for byte, are left as they are.

    Args:
        name: of the scene, instrument or study; the scene of a study is found by its name.
        folder: where it goes; it is made, with the folders within that the file names.
        force: replace files that differ.

    Returns:
        The paths of the copies, the named one first.

    Raises:
        SceneError: an unknown name, a file that differs, or a folder that cannot be written. Nothing is copied then.
    """
    source = find_shipped(name).path
    copies = {folder / path.relative_to(source.parent): path.read_bytes() for _, path in files_read(source, name)}
    changed = {path: text for path, text in copies.items() if not (path.is_file() and path.read_bytes() == text)}
    for path in changed:
        if not force:
            check_new(path)
    for path, text in changed.items():
        make_folder(path.parent)
        with atomic_path(path) as part:
            part.write_bytes(text)
    return list(copies)
