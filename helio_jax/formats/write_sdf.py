"""Write heights as SDF (ISO 25178-71) in its text form; a missing height is BAD.

Lengths are metres: heights are written in um, of which the header gives the scale. Profiles follow in the order of
increasing y. The trailer holds what is known of the data; no field, the position of the grid.
"""

from pathlib import Path

import numpy as np

from helio_jax.arrays import pitch
from helio_jax.formats.layers import Layers

_FLOAT64 = 7
"""Code of the data type."""


def write_sdf(layers: Layers, path: Path) -> None:
    """Write heights, one line of text for each profile."""
    ny, nx = layers.main.values.shape
    time = layers.time.strftime("%d%m%Y%H%M")
    header = {
        "ManufacID": "helio_jax",
        "CreateDate": time,
        "ModDate": time,
        "NumPoints": nx,
        "NumProfiles": ny,
        "Xscale": 1e-6 * pitch(layers.x),
        "Yscale": 1e-6 * pitch(layers.y),
        "Zscale": 1e-6,
        "Zresolution": -1.0,
        "Compression": 0,
        "DataType": _FLOAT64,
        "CheckType": 0,
    }
    texts = np.where(np.isfinite(layers.main.values), layers.main.values.astype(str), "BAD")
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write("aISO-1.0\n")
        file.writelines(f"{key} = {value}\n" for key, value in header.items())
        file.write("*\n")
        file.writelines(" ".join(row) + "\n" for row in texts)
        file.write(f"*\n{layers.comment.replace('*', ' ')}\n*\n")
