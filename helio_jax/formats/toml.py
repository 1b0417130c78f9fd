"""Write TOML: scenes that a study varies, instrument files that a fit calibrated."""

import json
import os
from collections.abc import Mapping
from typing import Any

from helio_jax.errors import SceneError
from helio_jax.formats.safe import atomic_path
from helio_jax.instrument import Instrument
from helio_jax.reconstruction import Reconstruction

_MOST = 30.0
"""Largest uncertainty of an angle that an instrument file may state [deg]."""
_COMMENT = """# Instrument file: the geometry that helio reconstruct fitted to {name}, for other scans of this
# instrument. [uncertainty] is what that fit left open, the largest of all detectors. How far the sample stands below
# the plate is a matter of the scene (plate.sample_distance_um); there it was {distance:.1f} um.

"""


def to_toml(tables: Mapping[str, Any]) -> str:
    """Return a tree of JSON-compatible values as TOML: one line per value below each top table; None is left out."""
    values = {k: v for k, v in tables.items() if not isinstance(v, Mapping) and v is not None}
    lines = [f"{_key(k)} = {_value(v)}" for k, v in values.items()]
    for name, table in tables.items():
        if isinstance(table, Mapping):
            lines += ["", f"[{_key(name)}]"]
            lines += [f"{_key(k)} = {_value(v)}" for k, v in table.items() if v is not None]
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items() if v is not None) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_value, value)) + "]"
    # JSON's texts, numbers and truth values are TOML's
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _key(key: str) -> str:
    return key if key.isascii() and key.replace("_", "").replace("-", "").isalnum() else json.dumps(key)


def _not_fitted(path: str | os.PathLike) -> SceneError:
    return SceneError(
        f"{path}: no directions of detectors are fitted: use refine, on a stack whose instrument file says how "
        "uncertain they are (polar_deg, azimuth_deg in the table [uncertainty])"
    )


def check_uncertain(instrument: Instrument, path: str | os.PathLike) -> None:
    """Refuse, before the work, a file of a fitted instrument of which nothing would be fitted.

    Raises:
        SceneError: the directions of the detectors are known.
    """
    if not instrument.uncertainty.polar_deg and not instrument.uncertainty.azimuth_deg:
        raise _not_fitted(path)


def write_instrument(rec: Reconstruction, path: str | os.PathLike) -> None:
    """Write the instrument that a fit found as an instrument file, which scenes may extend and `helio import` takes.

    The distance of the sample is left to the scene. The uncertainties are the posterior deviations of polar angles and
    azimuths, the largest of all detectors (those of the file that the fit started from where it did not fit them).

    Raises:
        SceneError: nothing of the geometry was fitted.
    """
    found = rec.provenance.get("instrument", {}).get("values", {})
    if not any(name.startswith(("polar ", "azimuth ")) for name in found):
        raise _not_fitted(path)
    tables = rec.instrument.model_dump(mode="json", exclude_none=True)
    tables["plate"].pop("sample_distance_um", None)
    for kind in ("polar", "azimuth"):
        of_kind = [std for name, (_, std, *_) in found.items() if name.startswith(f"{kind} ")]
        if of_kind:
            tables["uncertainty"][f"{kind}_deg"] = min(max(of_kind), _MOST)
    distance = rec.instrument.sample_distance
    name = str(rec.provenance.get("stack", {}).get("source", {}).get("file", "a scan"))
    with atomic_path(path) as part:
        part.write_text(_COMMENT.format(name=" ".join(name.split()), distance=distance) + to_toml(tables), "utf-8")
