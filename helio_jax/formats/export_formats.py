"""Formats of other programs: the one table from which writers, messages, `helio export --help` and the docs are made.

Imports nothing heavy, because the command line reads the table before it loads a writer. To add a format, see
docs/exports.md.
"""

from dataclasses import dataclass
from typing import Literal

Kind = Literal["heights", "micrographs"]


@dataclass(frozen=True)
class Format:
    """One format of other programs.

    Attributes:
        name: as its users call it.
        suffixes: of its files, lower case; the first one is usual.
        writer: "module:function" below helio_jax/formats; it is called as function(layers, path).
        kinds: what it can hold.
        amount: "image": one image; "core": images of heights or counts, of their error and of their mask; "all": all
            arrays.
        unit: of lengths in the file.
        numbers: how values are stored.
        missing: how a missing value is stored.
        first_row: where the file's first row of pixels lies, as its readers draw it.
        has_origin: whether it holds the position of the grid.
        has_text: whether it holds the status and what else is known as text.
        has_points: whether it holds the position of each point, so that no raster is needed.
        note: what else its users want to know.
    """

    name: str
    suffixes: tuple[str, ...]
    writer: str
    kinds: tuple[Kind, ...]
    amount: Literal["image", "core", "all"]
    unit: Literal["m", "um"]
    numbers: str
    missing: str
    first_row: Literal["bottom", "top", ""] = ""
    has_origin: bool = True
    has_text: bool = True
    has_points: bool = False
    note: str = ""


_BOTH: tuple[Kind, ...] = ("heights", "micrographs")

FORMATS = (
    Format(
        name="X3P",
        suffixes=(".x3p",),
        writer="write_x3p:write_x3p",
        kinds=("heights",),
        amount="image",
        unit="m",
        numbers="float64",
        missing="NaN",
        first_row="bottom",
        note="ISO 25178-72, ISO 5436-2",
    ),
    Format(
        name="SDF",
        suffixes=(".sdf",),
        writer="write_sdf:write_sdf",
        kinds=("heights",),
        amount="image",
        unit="m",
        numbers="text, exact",
        missing="BAD",
        first_row="bottom",
        has_origin=False,
        note="ISO 25178-71, text",
    ),
    Format(
        name="GWY",
        suffixes=(".gwy",),
        writer="write_gwyddion:write_gwy",
        kinds=_BOTH,
        amount="core",
        unit="m",
        numbers="float64",
        missing="masked",
        first_row="top",
        note="Gwyddion; below the mask, missing values are filled from the nearest pixel",
    ),
    Format(
        name="GSF",
        suffixes=(".gsf",),
        writer="write_gwyddion:write_gsf",
        kinds=_BOTH,
        amount="image",
        unit="m",
        numbers="float32",
        missing="NaN",
        first_row="top",
        note="Gwyddion simple field",
    ),
    Format(
        name="TIFF",
        suffixes=(
            ".tif",
            ".tiff",
        ),
        writer="write_tiff:write_tiff",
        kinds=_BOTH,
        amount="core",
        unit="um",
        numbers="float32",
        missing="NaN",
        first_row="top",
        has_origin=False,
        note="a page for each image; pixel size as resolution and as OME-XML",
    ),
    Format(
        name="PNG",
        suffixes=(".png",),
        writer="write_png:write_png",
        kinds=_BOTH,
        amount="image",
        unit="um",
        numbers="16-bit grey",
        missing="0, transparent",
        first_row="top",
        note="data, no colours; pixel size, limits and unit in its text",
    ),
    Format(
        name="STL",
        suffixes=(".stl",),
        writer="write_meshes:write_stl",
        kinds=("heights",),
        amount="image",
        unit="um",
        numbers="float32",
        missing="hole",
        has_text=False,
        has_points=True,
        note="binary; the format has no unit: choose um in the other program",
    ),
    Format(
        name="PLY",
        suffixes=(".ply",),
        writer="write_meshes:write_ply",
        kinds=("heights",),
        amount="core",
        unit="um",
        numbers="float64",
        missing="hole",
        has_points=True,
        note="binary; error and mask as properties of the vertices",
    ),
    Format(
        name="OBJ",
        suffixes=(".obj",),
        writer="write_meshes:write_obj",
        kinds=("heights",),
        amount="image",
        unit="um",
        numbers="text, exact",
        missing="hole",
        has_points=True,
    ),
    Format(
        name="MAT",
        suffixes=(".mat",),
        writer="write_arrays:write_mat",
        kinds=_BOTH,
        amount="all",
        unit="um",
        numbers="float64",
        missing="NaN",
        first_row="bottom",
        has_points=True,
        note="MATLAB level 5; simulated micrographs without noise in the layout of the reference simulator",
    ),
    Format(
        name="CSV",
        suffixes=(".csv",),
        writer="write_arrays:write_csv",
        kinds=_BOTH,
        amount="all",
        unit="um",
        numbers="text, exact",
        missing="nan",
        has_text=False,
        has_points=True,
        note="a row for each pixel; units in the names of the columns",
    ),
    Format(
        name="NPZ",
        suffixes=(".npz",),
        writer="write_arrays:write_npz",
        kinds=_BOTH,
        amount="all",
        unit="um",
        numbers="float64",
        missing="NaN",
        first_row="bottom",
        has_points=True,
        note="NumPy; a scene reads heights without gaps as a sample",
    ),
    Format(
        name="NetCDF",
        suffixes=(".nc",),
        writer="write_netcdf:write_netcdf",
        kinds=_BOTH,
        amount="all",
        unit="um",
        numbers="float64",
        missing="NaN",
        first_row="bottom",
        has_points=True,
        note="version 3, CF attributes",
    ),
)

SUFFIXES = tuple(suffix for known in FORMATS for suffix in known.suffixes)
"""Suffixes of all formats."""


def find_format(suffix: str) -> Format | None:
    """Return the format of a suffix, lower or upper case."""
    return next((known for known in FORMATS if suffix.lower() in known.suffixes), None)


def suffixes_for(kind: Kind) -> str:
    """List the suffixes that can hold heights, or micrographs."""
    return " ".join(known.suffixes[0] for known in FORMATS if kind in known.kinds)


def help_text() -> str:
    """Describe the table in a few lines, for the command line."""
    rows = [("suffix", "holds", "lengths", "numbers", "missing")]
    rows += [(" ".join(f.suffixes), " or ".join(f.kinds), f.unit, f.numbers, f.missing) for f in FORMATS]
    return "\n".join(
        f"{suffix:<11}{holds:<24}{unit:<9}{numbers:<13}{gap}" for suffix, holds, unit, numbers, gap in rows
    )


def markdown_table() -> str:
    """Describe the table for docs/exports.md."""
    amounts = {"image": "one image", "core": "with error and mask", "all": "all arrays"}
    rows = [("suffix", "format", "holds", "lengths", "numbers", "missing", "first row", "remarks"), ("---",) * 8]
    for f in FORMATS:
        holds = f"{' or '.join(f.kinds)}, {amounts[f.amount]}"
        suffixes = ", ".join(f"`{suffix}`" for suffix in f.suffixes)
        rows.append((suffixes, f.name, holds, f.unit, f.numbers, f.missing, f.first_row or "-", f.note or "-"))
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)
