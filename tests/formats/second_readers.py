"""Second readers of exported files: other people's programs, or the format's description; no code of the writers.

Each returns what it finds in one frame: images [y, x] with y upwards, lengths in um, NaN where a value is missing.
"""

import ast
import csv
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import gsffile
import gwyfile
import mat4py
import netCDF4
import numpy as np
import sdfio
import tifffile
import trimesh
import x3pio
from PIL import Image


@dataclass
class Found:
    """What a file holds: images by name, pixel size, position of pixel (0, 0), and texts; None: not in the file."""

    images: dict[str, np.ndarray]
    steps: tuple[float, float]
    first: tuple[float, float] | None = None
    texts: dict = field(default_factory=dict)


def _axes(x, y) -> dict:
    """Pixel size and position of two axes."""
    x, y = np.asarray(x, float).ravel(), np.asarray(y, float).ravel()
    return {"steps": (x[1] - x[0], y[1] - y[0]), "first": (x[0], y[0])}


def read_x3p(path: Path) -> Found:
    """By x3pio (MIT), which also verifies both checksums. X3P is a right-handed frame: row 0 is the lowest y."""
    surface = x3pio.read(path)
    layer = surface.layers[0]
    points = layer.points()
    axes = _axes(1e6 * points[0, :, 0], 1e6 * points[:, 0, 1])
    return Found({"height": 1e6 * layer.z}, **axes, texts={"comment": surface.metadata.comment})


def read_sdf(path: Path) -> Found:
    """By sdfio (MIT): y increases with the row."""
    sdf = sdfio.read(path)
    return Found({"height": 1e6 * sdf.data}, (1e6 * sdf.header.x_scale, 1e6 * sdf.header.y_scale))


def read_gwy(path: Path) -> Found:
    """By gwyfile (MIT): row 0 is the top, y counts downwards, what is below a mask is missing."""
    container = gwyfile.load(str(path))
    images, n = {}, 0
    while f"/{n}/data" in container:
        channel = container[f"/{n}/data"]
        unit = channel["si_unit_z"]["unitstr"]
        values = channel.data * {"m": 1e6}.get(unit, 1.0)
        assert np.all(np.isfinite(values))
        if f"/{n}/mask" in container:
            values = np.where(container[f"/{n}/mask"].data > 0, np.nan, values)
        images[container[f"/{n}/data/title"]] = values[::-1]
        n += 1
    first = container["/0/data"]
    assert first["si_unit_xy"]["unitstr"] == "m"
    steps = (1e6 * first["xreal"] / first["xres"], 1e6 * first["yreal"] / first["yres"])
    corner = (1e6 * first["xoff"] + steps[0] / 2, -1e6 * (first["yoff"] + first["yreal"]) + steps[1] / 2)
    return Found(images, steps, corner, {"shown": [bool(container[f"/{k}/data/visible"]) for k in range(n)]})


def read_gsf(path: Path) -> Found:
    """By gsffile (MIT): row 0 is the top, y counts downwards."""
    values, meta = gsffile.read_gsf(path)
    assert meta["XYUnits"] == "m"
    scale = 1e6 if meta.get("ZUnits") == "m" else 1.0
    steps = (1e6 * meta["XReal"] / values.shape[1], 1e6 * meta["YReal"] / values.shape[0])
    first = (1e6 * meta["XOffset"] + steps[0] / 2, -1e6 * (meta["YOffset"] + meta["YReal"]) + steps[1] / 2)
    return Found({meta["Title"]: scale * values.astype(float)[::-1]}, steps, first)


def read_tiff(path: Path) -> Found:
    """By tifffile (BSD): row 0 is the top; the resolution and the OME-XML state the same pixel size."""
    with tifffile.TiffFile(path) as file:
        pages = [page.aspage() for page in file.pages]
        pixels = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]["Pixels"]
        channels = pixels["Channel"] if isinstance(pixels["Channel"], list) else [pixels["Channel"]]
        names = [page.tags["PageName"].value for page in pages]
        assert names == [channel["Name"] for channel in channels] and pixels["PhysicalSizeXUnit"] == "\u00b5m"
        assert all(page.dtype == np.float32 for page in pages) and file.series[0].size == sum(p.size for p in pages)
        assert pages[0].tags["ResolutionUnit"].value == 3  # centimetre
        ratios = (pages[0].tags[tag].value for tag in ("XResolution", "YResolution"))
        steps = tuple(1e4 * ratio[1] / ratio[0] for ratio in ratios)
        np.testing.assert_allclose(steps, (pixels["PhysicalSizeX"], pixels["PhysicalSizeY"]), rtol=1e-8)
        return Found({n: page.asarray().astype(float)[::-1] for n, page in zip(names, pages, strict=True)}, steps)


def read_png(path: Path) -> Found:
    """By Pillow (MIT-CMU): row 0 is the top; the transparent grey is a missing value."""
    with Image.open(path) as image:
        grey, info = np.asarray(image).astype(float)[::-1], image.info
    low, high = float(info["low"]), float(info["high"])
    values = np.where(grey == info["transparency"], np.nan, low + (grey - 1) / 65534 * (high - low))
    steps = (float(info["pixel_size_x_um"]), float(info["pixel_size_y_um"]))
    np.testing.assert_allclose(info["dpi"], [25400 / step for step in steps], rtol=1e-3)
    first = (float(info["first_column_x_um"]), float(info["last_row_y_um"]))
    return Found({info["Title"]: values}, steps, first, {"unit": info["unit"]})


def read_mesh(path: Path) -> trimesh.Trimesh:
    """By trimesh (MIT)."""
    return trimesh.load(path, process=False)


def read_mat(path: Path) -> Found:
    """By mat4py (MIT), which does not use SciPy."""
    tree = mat4py.loadmat(str(path))
    images = {}
    for name in tree["units"]:
        value = tree[name]
        if name in ("x", "y", "point_x", "point_y"):
            continue
        for labels, image in _leaves(value, tree["detectors"]):
            images["_".join([name, *labels])] = np.array(image, float)
    return Found(images, **_axes(tree["x"], tree["y"]), texts={"units": tree["units"], "about": tree["about"]})


def _leaves(value, detectors, labels=()):
    """Yield images of nested cells: their labels, their rows of numbers."""
    if not isinstance(value[0][0], list):
        yield labels, value
        return
    for i, item in enumerate(value):
        label = detectors[i] if len(value) == len(detectors) else str(i + 1)
        yield from _leaves(item, detectors, (*labels, label))


def read_csv(path: Path) -> Found:
    """By Python's csv module: a row for each pixel."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    columns = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    shape = tuple(int(columns[name].max()) + 1 for name in ("row", "column"))
    place = tuple(columns.pop(name).astype(int) for name in ("row", "column"))
    images = {}
    for name, column in columns.items():
        images[name] = np.full(shape, np.inf)
        images[name][place] = column
    return Found(images, **_axes(images["x_um"][0], images["y_um"][:, 0]))


def read_npz(path: Path) -> Found:
    """By zipfile and the description of .npy: magic, version, length and text of a header, then the numbers."""
    arrays = {}
    with zipfile.ZipFile(path) as archive:
        assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
        for name in archive.namelist():
            data = archive.read(name)
            assert data[:8] == b"\x93NUMPY\x01\x00"
            n = int.from_bytes(data[8:10], "little")
            header = ast.literal_eval(data[10 : 10 + n].decode("latin1"))
            assert not header["fortran_order"]
            kind = np.dtype(header["descr"])
            arrays[name.removesuffix(".npy")] = np.frombuffer(data[10 + n :], kind).reshape(header["shape"])
    units = {name.removeprefix("unit_"): str(unit) for name, unit in arrays.items() if name.startswith("unit_")}
    detectors = [str(name) for name in arrays.get("detectors", ())]
    images = {}
    for name in units:
        array = arrays[name]
        for index in np.ndindex(array.shape[:-2]) if array.ndim >= 2 else ():
            axes = zip(index, array.shape, strict=False)
            labels = [detectors[i] if n == len(detectors) else str(i + 1) for i, n in axes]
            images["_".join([name, *labels])] = array[index].astype(float)
    return Found(images, **_axes(arrays["x"], arrays["y"]), texts={"units": units})


def read_netcdf(path: Path) -> Found:
    """By netCDF4 (MIT), the C library."""
    with netCDF4.Dataset(path) as file:
        variables = {name: variable for name, variable in file.variables.items() if variable.dimensions[-1:] == ("x",)}
        detectors = []
        if "detector_name" in file.variables:
            detectors = [str(name) for name in netCDF4.chartostring(file["detector_name"][:])]
        images = {}
        for name, variable in variables.items():
            array = np.ma.filled(variable[:].astype(float), np.nan)
            for index in np.ndindex(array.shape[:-2]) if array.ndim >= 2 else ():
                axes = zip(variable.dimensions, index, strict=False)
                labels = [detectors[i] if axis == "detector" else str(i + 1) for axis, i in axes]
                images["_".join([name, *labels])] = array[index]
        assert file["x"].units == file["y"].units == "um"
        about = {name: getattr(file, name) for name in file.ncattrs()}
        flags = {n: v.flag_meanings.split() for n, v in variables.items() if "flag_meanings" in v.ncattrs()}
        units = {n: v.units for n, v in variables.items()}
        return Found(
            images, **_axes(file["x"][:], file["y"][:]), texts={"about": about, "flags": flags, "units": units}
        )


READERS = {
    ".x3p": read_x3p,
    ".sdf": read_sdf,
    ".gwy": read_gwy,
    ".gsf": read_gsf,
    ".tif": read_tiff,
    ".tiff": read_tiff,
    ".png": read_png,
    ".stl": read_mesh,
    ".ply": read_mesh,
    ".obj": read_mesh,
    ".mat": read_mat,
    ".csv": read_csv,
    ".npz": read_npz,
    ".nc": read_netcdf,
}
"""Reader of each suffix."""
