"""Starting files of a scene and of an instrument, written from the settings models, so that no key or default is stale.

What a person has to decide has a value. Every other key is a comment with its default.
"""

import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from helio_jax.calibration.noise import NoiseSettings
from helio_jax.detector import Detector
from helio_jax.formats.safe import atomic_path, check_new
from helio_jax.formats.toml import value_text
from helio_jax.instrument import Beam, Instrument, Plate, Uncertainty
from helio_jax.inverse.settings import ReconstructSettings
from helio_jax.scene.scan import Raster
from helio_jax.scene.shapes import Sphere, SpheresSample
from helio_jax.scores.settings import TruthSettings
from helio_jax.settings import Settings
from helio_jax.trace.settings import TraceSettings

Startable = Literal["scene", "instrument"]
"""What a starting file can be of."""
INSTRUMENT = Instrument(
    beam=Beam(incidence_deg=30.0, azimuth_deg=0.0),
    plate=Plate(kind="transparent", working_distance_um=4000.0),
    uncertainty=Uncertainty(),
    detector=(
        Detector(name="forward", polar_deg=30.0, azimuth_deg=0.0, half_angle_deg=8.0),
        Detector(name="left", polar_deg=30.0, azimuth_deg=120.0, half_angle_deg=8.0),
        Detector(name="right", polar_deg=30.0, azimuth_deg=-120.0, half_angle_deg=8.0),
    ),
)
"""The instrument of the starting file."""
SCENE = {
    "sample": SpheresSample(
        kind="spheres",
        size_um=4000.0,
        place="top-at-working-distance",
        spheres=(Sphere(radius_um=500.0, cap_height_um=150.0, center_um=(0.0, 0.0)),),
    ),
    "scan": Raster(kind="raster", nx=41, ny=41, pixel_size_um=30.0),
    "trace": TraceSettings(rays=64, seed=1),
    "noise": NoiseSettings(),
    "reconstruct": ReconstructSettings(method="refine"),
    "truth": TruthSettings(region_radius_um=360.0, substrate_radius_um=430.0),
}
"""The tables of the starting scene, which extends `EXTENDED`."""
EXTENDED = "bshem_wd4"
"""Instrument of the starting scene."""
_ABOUT = """Lengths are micrometres (_um), angles degrees (_deg). A line that begins with "# key = value" shows a \
default: remove the # to change it. "# key =" has none. helio validate FILE checks the file, helio schema lists all \
keys."""
_INSTRUMENT_ABOUT = """Instrument file: beam, pinhole plate and detectors. For scenes (extends = "FILE"), and for \
helio import --instrument FILE.

z points from the sample up to the plate. Azimuths run counter-clockwise from +x, seen from above. The nominal spot is \
where the beam's axis is working_distance_um below the plate."""
_SCENE_ABOUT = """Scene file: a sample, how it is scanned, and the instrument that it extends. Try it with \
helio run FILE.

extends names the instrument: a name that helio scenes lists, or a file (helio init instrument). Tables [beam], \
[plate] and [uncertainty] here change single keys of it; a [[detector]] here replaces all of its detectors, an \
[[append.detector]] adds one."""
_COLUMN, _WIDTH = 34, 118


def starting_text(kind: Startable) -> str:
    """Return the text of a starting file."""
    if kind == "instrument":
        first, *others = INSTRUMENT.detector
        parts = [_comment(f"{_INSTRUMENT_ABOUT}\n\n{_ABOUT}")]
        parts += [_table(f"[{name}]", getattr(INSTRUMENT, name)) for name in ("beam", "plate", "uncertainty")]
        parts += [_table("[[detector]]", first), *(_table("[[detector]]", d, is_short=True) for d in others)]
    else:
        parts = [_comment(f"{_SCENE_ABOUT}\n\n{_ABOUT}"), [f"extends = {value_text(EXTENDED)}"]]
        parts += [_table(f"[{name}]", table) for name, table in SCENE.items()]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def write_starting_file(kind: Startable, path: Path, *, force: bool = False) -> None:
    """Write a starting file.

    Raises:
        SceneError: the file exists and `force` is false, or it cannot be written.
    """
    if not force:
        check_new(path)
    with atomic_path(path) as part:
        part.write_text(starting_text(kind), encoding="utf-8")


def _table(head: str, table: Settings, *, is_short: bool = False) -> list[str]:
    """Format a table: keys that are set, then the others as comments, then the tables within; short: keys alone."""
    given = table.model_fields_set
    lines, below = [head], []
    values = table.model_dump(mode="json")
    for name in sorted(type(table).model_fields, key=lambda name: (name not in given, name != "kind")):
        field, value = type(table).model_fields[name], getattr(table, name)
        about = "" if is_short else field.description or ""
        if isinstance(value, tuple) and any(isinstance(element, Settings) for element in value):
            below += [line for element in value for line in ("", *_table(f"[[{head.strip('[]')}.{name}]]", element))]
        elif isinstance(value, Settings):
            below += ["", *_comment(f"[{head.strip('[]')}.{name}] has more settings: helio schema")]
        elif name in given:
            lines += _entry(f"{name} = {value_text(values[name])}", about)
        elif not is_short:
            lines += _entry(f"# {name} =" if value is None else f"# {name} = {value_text(values[name])}", about)
    return lines + below


def _entry(entry: str, about: str) -> Iterator[str]:
    """Yield a key with its meaning beside it."""
    pad = max(_COLUMN, len(entry) + 2)
    words = textwrap.wrap(" ".join(about.replace("`", "").split()), _WIDTH - pad - 2, break_on_hyphens=False) or [""]
    yield f"{entry:<{pad}}# {words[0]}" if words[0] else entry
    for line in words[1:]:
        yield f"{'#':<{pad}}# {line}"


def _comment(text: str) -> list[str]:
    """Format paragraphs as a comment."""
    wrapped = (textwrap.wrap(paragraph, _WIDTH - 2, break_long_words=False) for paragraph in text.split("\n"))
    return [f"# {line}".rstrip() for lines in wrapped for line in (lines or [""])]
