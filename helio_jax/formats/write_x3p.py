"""Write heights as X3P (ISO 25178-72, ISO 5436-2): a zip of main.xml, the heights and their checksums.

Lengths are metres. Row 0 is the lowest y, as in the right-handed frame of the standard; missing heights are NaN. The
zip's dates are fixed, so that equal data give equal bytes.
"""

import hashlib
import zipfile
from pathlib import Path
from xml.sax.saxutils import escape

from helio_jax.arrays import pitch
from helio_jax.formats.layers import Layers

_DATA = "bindata/data.bin"
_CHECKSUM = "md5checksum.hex"
_DATE = (1980, 1, 1, 0, 0, 0)
_MAIN = """<?xml version="1.0" encoding="UTF-8"?>
<p:ISO5436_2 xmlns:p="http://www.opengps.eu/2008/ISO5436_2">
  <Record1>
    <Revision>ISO5436 - 2000</Revision>
    <FeatureType>SUR</FeatureType>
    <Axes>
      <CX><AxisType>I</AxisType><DataType>D</DataType><Increment>{step_x!r}</Increment><Offset>{x!r}</Offset></CX>
      <CY><AxisType>I</AxisType><DataType>D</DataType><Increment>{step_y!r}</Increment><Offset>{y!r}</Offset></CY>
      <CZ><AxisType>A</AxisType><DataType>D</DataType><Increment>1.0</Increment><Offset>0.0</Offset></CZ>
    </Axes>
  </Record1>
  <Record2>
    <Date>{time}</Date>
    <Creator>helio_jax</Creator>
    <Instrument>
      <Manufacturer>helio_jax</Manufacturer><Model>scanning helium microscope</Model><Serial></Serial>
      <Version>{version}</Version>
    </Instrument>
    <CalibrationDate>{time}</CalibrationDate>
    <ProbingSystem><Type>NonContacting</Type><Identification>beam of helium atoms</Identification></ProbingSystem>
    <Comment>{comment}</Comment>
  </Record2>
  <Record3>
    <MatrixDimension><SizeX>{nx}</SizeX><SizeY>{ny}</SizeY><SizeZ>1</SizeZ></MatrixDimension>
    <DataLink>
      <PointDataLink>{link}</PointDataLink>
      <MD5ChecksumPointData>{md5}</MD5ChecksumPointData>
    </DataLink>
  </Record3>
  <Record4><ChecksumFile>{checksum}</ChecksumFile></Record4>
</p:ISO5436_2>
"""
"""Element names, order and namespace: the schema of ISO 5436-2."""


def write_x3p(layers: Layers, path: Path) -> None:
    """Write heights as the points of one surface."""
    import helio_jax

    ny, nx = layers.main.values.shape
    data = (1e-6 * layers.main.values).astype("<f8").tobytes()
    main = _MAIN.format(
        step_x=1e-6 * pitch(layers.x),
        step_y=1e-6 * pitch(layers.y),
        x=1e-6 * float(layers.x[0]),
        y=1e-6 * float(layers.y[0]),
        time=layers.time.isoformat(),
        version=helio_jax.__version__,
        comment=escape(layers.comment),
        nx=nx,
        ny=ny,
        link=_DATA,
        md5=hashlib.md5(data, usedforsecurity=False).hexdigest().upper(),
        checksum=_CHECKSUM,
    ).encode()
    checksum = f"{hashlib.md5(main, usedforsecurity=False).hexdigest()} *main.xml\n".encode()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in (("main.xml", main), (_DATA, data), (_CHECKSUM, checksum)):
            archive.writestr(zipfile.ZipInfo(name, _DATE), content, zipfile.ZIP_DEFLATED)
