"""Write Gwyddion's two formats from their published descriptions: GWY (several images, masks) and GSF (one image).

Lengths are metres. The first row is the top of the image, so that y is turned round: what is up in our figures is up
there. Gwyddion counts y downwards: its y is minus ours.
"""

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from helio_jax.arrays import nearest_known, pitch
from helio_jax.errors import SceneError
from helio_jax.formats.layers import Image, Layers

_METRES = {"um": (1e-6, "m")}
"""Factor and name of units that these formats have in SI."""


def _scaled(image: Image) -> tuple[np.ndarray, str]:
    """Return values in SI with the first row at the top, and their unit."""
    factor, unit = _METRES.get(image.unit, (1.0, "" if image.unit == "counts" else image.unit))
    return factor * image.values[::-1], unit


def _frame(layers: Layers) -> dict[str, float]:
    """Return the sides and the upper left corner of the images [m], y downwards."""
    step_x, step_y = pitch(layers.x), pitch(layers.y)
    return {
        "xreal": 1e-6 * step_x * layers.x.size,
        "yreal": 1e-6 * step_y * layers.y.size,
        "xoff": 1e-6 * float(layers.x[0] - 0.5 * step_x),
        "yoff": -1e-6 * float(layers.y[-1] + 0.5 * step_y),
    }


def write_gsf(layers: Layers, path: Path) -> None:
    """Write one image in single precision; missing values are NaN."""
    image = layers.images([layers.main])[0]
    values, unit = _scaled(image)
    frame = _frame(layers)
    fields = {
        "XRes": values.shape[1],
        "YRes": values.shape[0],
        "XReal": repr(frame["xreal"]),
        "YReal": repr(frame["yreal"]),
        "XOffset": repr(frame["xoff"]),
        "YOffset": repr(frame["yoff"]),
        "XYUnits": "m",
        "ZUnits": unit,
        "Title": image.name,
        "Comment": layers.comment,
    }
    header = "Gwyddion Simple Field 1.0\n" + "".join(f"{key} = {value}\n" for key, value in fields.items())
    text = header.encode()
    path.write_bytes(text + b"\0" * (4 - len(text) % 4) + values.astype("<f4").tobytes())


def write_gwy(layers: Layers, path: Path) -> None:
    """Write images as channels; only heights or counts are shown when the file is opened.

    Gwyddion's images hold numbers everywhere: a missing value is that of the nearest pixel, below the channel's mask.
    """
    parts, n_shown = [], len(layers.images([layers.main]))
    for number, image in enumerate(layers.images()):
        values, unit = _scaled(image)
        is_missing = ~image.is_known[::-1]
        parts += [
            _object(f"/{number}/data", "GwyDataField", _field(layers, _without_nan(values, image.name), unit)),
            _text(f"/{number}/data/title", image.name),
            _packed(f"/{number}/data/visible", "b", struct.pack("<?", number < n_shown)),
        ]
        if is_missing.any():
            mask = _field(layers, is_missing.astype(np.float64), "")
            parts.append(_object(f"/{number}/mask", "GwyDataField", mask))
        meta = [_text(key, value) for key, value in {"meaning": image.meaning, **layers.about}.items()]
        parts.append(_object(f"/{number}/meta", "GwyContainer", meta))
    path.write_bytes(b"GWYP" + _body("GwyContainer", parts))


def _without_nan(values: np.ndarray, name: str) -> np.ndarray:
    """Give each missing value that of the nearest pixel."""
    is_number = np.isfinite(values)
    if not is_number.any():
        raise SceneError(f"{name}: no pixel has a value; this format cannot hold such an image: write .npz or .gsf")
    return values if is_number.all() else values[nearest_known(is_number)]


def _field(layers: Layers, values: np.ndarray, unit: str) -> list[bytes]:
    """Pack the components of a GwyDataField."""
    ny, nx = values.shape
    return [
        _packed("xres", "i", struct.pack("<i", nx)),
        _packed("yres", "i", struct.pack("<i", ny)),
        *(_packed(name, "d", struct.pack("<d", value)) for name, value in _frame(layers).items()),
        _object("si_unit_xy", "GwySIUnit", [_text("unitstr", "m")]),
        _object("si_unit_z", "GwySIUnit", [_text("unitstr", unit)]),
        _packed("data", "D", struct.pack("<I", values.size) + values.astype("<f8").tobytes()),
    ]


def _packed(name: str, kind: str, data: bytes) -> bytes:
    """Pack one component: its name, the letter of its type, its data."""
    return name.encode() + b"\0" + kind.encode() + data


def _text(name: str, value: str) -> bytes:
    """Pack a text."""
    return _packed(name, "s", value.encode() + b"\0")


def _object(name: str, kind: str, parts: Sequence[bytes]) -> bytes:
    """Pack an object."""
    return _packed(name, "o", _body(kind, parts))


def _body(kind: str, parts: Sequence[bytes]) -> bytes:
    """Pack an object's type, size and components."""
    data = b"".join(parts)
    return kind.encode() + b"\0" + struct.pack("<I", len(data)) + data
