"""Write one image as PNG, 16-bit grey: data for other programs, no picture in colours (`helio report` has those).

Grey n >= 1 stands for low + (n - 1) (high - low) / 65534; 0 is a missing value and transparent. The text of the file
holds low, high, unit, pixel size and position. The first row is the top of the image.
"""

import struct
import zlib
from pathlib import Path

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.formats.layers import Layers

_STEPS = 2**16 - 2
_GREY = 0
_PER_METRE = 1


def write_png(layers: Layers, path: Path) -> None:
    """Write heights or counts of one detector."""
    image = layers.images([layers.main])[0]
    values = image.values[::-1]
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    grey = np.where(np.isfinite(values), 1 + np.round((values - low) / ((high - low) or 1.0) * _STEPS), 0)
    step_x, step_y = pitch(layers.x), pitch(layers.y)
    texts = {
        "Title": image.name,
        "Software": "helio_jax",
        "Comment": layers.comment,
        "Scale": "value = low + (grey - 1) * (high - low) / 65534; grey 0: missing",
        "low": repr(low),
        "high": repr(high),
        "unit": image.unit,
        "pixel_size_x_um": repr(step_x),
        "pixel_size_y_um": repr(step_y),
        "first_column_x_um": repr(float(layers.x[0])),
        "last_row_y_um": repr(float(layers.y[0])),
    }
    ny, nx = values.shape
    rows = np.zeros((ny, 1 + 2 * nx), np.uint8)  # each row begins with the number of its filter: none
    rows[:, 1:] = grey.astype(">u2").view(np.uint8).reshape(ny, 2 * nx)
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", nx, ny, 16, _GREY, 0, 0, 0)),
        (b"tRNS", struct.pack(">H", 0)),
        (b"pHYs", struct.pack(">IIB", *(max(1, round(1e6 / step)) for step in (step_x, step_y)), _PER_METRE)),
        *((b"iTXt", key.encode() + b"\0\0\0\0\0" + text.encode()) for key, text in texts.items()),
        (b"IDAT", zlib.compress(rows.tobytes(), 9)),
        (b"IEND", b""),
    ]
    packed = (struct.pack(">I", len(data)) + kind + data + _checksum(kind + data) for kind, data in chunks)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(packed))


def _checksum(data: bytes) -> bytes:
    """Pack the checksum of a chunk."""
    return struct.pack(">I", zlib.crc32(data))
