"""Write images as the pages of a TIFF file (version 6, float32), heights or counts first.

The first row is the top of the image. The pixel size stands in the resolution (pixels per cm) and, with the names of
the pages, in OME-XML. Lengths are um; missing values are NaN.
"""

import struct
from fractions import Fraction
from pathlib import Path
from xml.sax.saxutils import escape, quoteattr

from helio_jax.arrays import pitch
from helio_jax.errors import SceneError
from helio_jax.formats.layers import Image, Layers

_UM_PER_CM = 1e4
_ASCII, _SHORT, _LONG, _RATIONAL = 2, 3, 4, 5
_MAX_DENOMINATOR = 100_000
_MAX_BYTES = 2**32 - 2**20


def write_tiff(layers: Layers, path: Path) -> None:
    """Write all images as pages.

    Raises:
        SceneError: they need 4 GB or more, which the format cannot address.
    """
    images = layers.images()
    if (n_bytes := 4 * sum(image.values.size for image in images)) > _MAX_BYTES:
        raise SceneError(f"a TIFF file must be smaller than 4 GB, these images have {n_bytes / 1e9:.1f} GB: write .nc")
    with path.open("wb") as file:
        file.write(b"II*\0\0\0\0\0")
        link = 4  # where the offset of the next directory is to be written
        for number, image in enumerate(images):
            strip = file.tell()
            file.write(image.values[::-1].astype("<f4").tobytes())
            about = _ome(layers, images) if number == 0 else image.meaning
            entries, rest = _directory(layers, image, about, strip)
            start = file.tell()
            file.write(entries)
            next_link = file.tell() - 4
            file.write(rest)
            file.write(b"\0" * (file.tell() % 2))
            file.seek(link)
            file.write(struct.pack("<I", start))
            file.seek(0, 2)
            link = next_link


def _directory(layers: Layers, image: Image, about: str, strip: int) -> tuple[bytes, bytes]:
    """Pack the tags of one page, which begin after its strip of pixels; return them and what does not fit in them."""
    ny, nx = image.values.shape
    tags = [
        (256, _LONG, nx),
        (257, _LONG, ny),
        (258, _SHORT, 32),  # bits of a value
        (259, _SHORT, 1),  # no compression
        (262, _SHORT, 1),  # larger is brighter
        (270, _ASCII, about),
        (273, _LONG, strip),
        (277, _SHORT, 1),  # one value per pixel
        (278, _LONG, ny),  # all rows in one strip
        (279, _LONG, 4 * nx * ny),
        (282, _RATIONAL, _UM_PER_CM / pitch(layers.x)),
        (283, _RATIONAL, _UM_PER_CM / pitch(layers.y)),
        (285, _ASCII, image.name),
        (296, _SHORT, 3),  # resolution per cm
        (305, _ASCII, "helio_jax"),
        (339, _SHORT, 3),  # floating point
    ]
    after = strip + 4 * nx * ny + 2 + 12 * len(tags) + 4
    entries, rest = struct.pack("<H", len(tags)), b""
    for tag, kind, value in tags:
        data = _value(kind, value)
        count = len(data) if kind == _ASCII else 1
        if len(data) > 4:
            place = struct.pack("<I", after + len(rest))
            rest += data + b"\0" * (len(data) % 2)
        else:
            place = data.ljust(4, b"\0")
        entries += struct.pack("<HHI", tag, kind, count) + place
    return entries + b"\0\0\0\0", rest


def _value(kind: int, value: str | float) -> bytes:
    """Pack the value of a tag."""
    if isinstance(value, str):
        return value.encode("ascii", "xmlcharrefreplace") + b"\0"
    if kind == _RATIONAL:
        ratio = Fraction(value).limit_denominator(_MAX_DENOMINATOR)
        return struct.pack("<II", ratio.numerator, ratio.denominator)
    return struct.pack("<H" if kind == _SHORT else "<I", int(value))


def _ome(layers: Layers, images: list[Image]) -> str:
    """Describe the pages in OME-XML: the pages are channels, the pixels have a size."""
    ny, nx = images[0].values.shape
    names = "".join(
        f'<Channel ID="Channel:0:{k}" Name={quoteattr(image.name)} SamplesPerPixel="1"/>'
        for k, image in enumerate(images)
    )
    pages = "".join(f'<TiffData FirstC="{k}" IFD="{k}" PlaneCount="1"/>' for k in range(len(images)))
    return (
        '<?xml version="1.0" encoding="UTF-8"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06">'
        f'<Image ID="Image:0" Name={quoteattr(layers.title)}><Description>{escape(layers.comment)}</Description>'
        f'<Pixels ID="Pixels:0" DimensionOrder="XYCZT" '
        f'Type="float" BigEndian="false" SizeX="{nx}" SizeY="{ny}" SizeC="{len(images)}" SizeZ="1" SizeT="1" '
        f'PhysicalSizeX="{pitch(layers.x)!r}" PhysicalSizeXUnit="\u00b5m" '
        f'PhysicalSizeY="{pitch(layers.y)!r}" PhysicalSizeYUnit="\u00b5m">{names}{pages}</Pixels></Image></OME>'
    )
