"""Write TOML: scenes of a study, instrument files with a fitted geometry, single values."""

import json
import os
from collections.abc import Mapping
from typing import Any

from helio_jax.errors import SceneError
from helio_jax.formats.safe import atomic_path
from helio_jax.instrument import Instrument
from helio_jax.reconstruction import Reconstruction

_MAX_ANGLE_STD = 30.0
"""Largest uncertainty of an angle that an instrument file may state [deg]."""
_COMMENT = """# Instrument file: the geometry that helio reconstruct fitted to {name}, for other scans of this
# instrument. [uncertainty] holds the posterior standard deviations, the largest of all detectors. The sample distance
# belongs to the scene (plate.sample_distance_um); in the fit it was {distance:.1f} um.

"""

_WIDTH = 120
"""Longest line that is kept [characters]."""


def to_toml(tables: Mapping[str, Any]) -> str:
    """Format a tree of JSON-compatible values as TOML, one line per value below each top table; None is omitted.

    A list of tables becomes one table after the other; below a table, and a matrix row after row, where a line is too
    short for it.
    """
    listed = {k: v for k, v in tables.items() if _is_list_of(v, Mapping)}
    values = {k: v for k, v in tables.items() if not isinstance(v, Mapping) and v is not None and k not in listed}
    lines = [_line(k, v) for k, v in values.items()]
    for name, found in tables.items():
        head = f"[[{_key(name)}]]" if name in listed else f"[{_key(name)}]"
        for table in found if name in listed else [found] if isinstance(found, Mapping) else []:
            known = {k: _line(k, v) for k, v in table.items() if v is not None}
            long = [k for k, line in known.items() if _is_list_of(table[k], Mapping) and len(line) > _WIDTH]
            lines += ["", head, *(line for k, line in known.items() if k not in long)]
            for k in long:
                for part in table[k]:
                    below = [_line(key, v) for key, v in part.items() if v is not None]
                    lines += ["", f"[[{_key(name)}.{_key(k)}]]", *below]
    return "\n".join(lines) + "\n"


def _is_list_of(value: Any, kind: type) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(v, kind) for v in value)


def _line(key: str, value: Any) -> str:
    """Format a key and its value: on one line, or a long matrix one row a line."""
    line = f"{_key(key)} = {value_text(value)}"
    if len(line) <= _WIDTH or not _is_list_of(value, list):
        return line
    return f"{_key(key)} = [\n" + "".join(f"    {value_text(row)},\n" for row in value) + "]"


def value_text(value: Any) -> str:
    """Format one JSON-compatible value as TOML, on one line."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {value_text(v)}" for k, v in value.items() if v is not None) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(value_text, value)) + "]"
    # JSON's texts, numbers and truth values are TOML's
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _key(key: str) -> str:
    return key if key.isascii() and key.replace("_", "").replace("-", "").isalnum() else json.dumps(key)


def write_calibrated(instrument: Instrument, path: str | os.PathLike, comment: str) -> None:
    """Write a calibrated instrument with its covariance, numbers to 6 digits.

    Args:
        instrument: as calibrated; its sample distance is that of the calibrating scans' stage height.
        path: of the file.
        comment: lines that say where the numbers come from.
    """
    tables = _rounded(instrument.model_dump(mode="json", exclude_none=True, exclude_defaults=True))
    head = "".join(f"# {' '.join(line.split())}\n" for line in comment.splitlines())
    with atomic_path(path) as part:
        part.write_text(head + to_toml(tables), "utf-8")


def _rounded(value: Any) -> Any:
    """Round all numbers of a tree to 6 significant digits."""
    if isinstance(value, Mapping):
        return {k: _rounded(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def _not_fitted(path: str | os.PathLike) -> SceneError:
    return SceneError(
        f"{path}: no directions of detectors are fitted: use refine, on a stack whose instrument file states their "
        "uncertainty (polar_deg, azimuth_deg in the table [uncertainty])"
    )


def check_uncertain(instrument: Instrument, path: str | os.PathLike) -> None:
    """Check, before a fit, that the fit will determine the geometry to be written.

    Raises:
        SceneError: the instrument states no uncertainty of the detectors' directions.
    """
    if not instrument.uncertainty.polar_deg and not instrument.uncertainty.azimuth_deg:
        raise _not_fitted(path)


def write_instrument(rec: Reconstruction, path: str | os.PathLike) -> None:
    """Write the fitted instrument as an instrument file, for scenes (`extends`) and `helio import`.

    The sample distance is omitted, it belongs to the scene. The uncertainties of polar angles and azimuths are their
    posterior standard deviations, the largest of all detectors; angles that were not fitted keep their prior.

    Raises:
        SceneError: no direction of a detector was fitted.
    """
    found = rec.provenance.get("instrument", {}).get("values", {})
    if not any(name.startswith(("polar ", "azimuth ")) for name in found):
        raise _not_fitted(path)
    tables = rec.instrument.model_dump(mode="json", exclude_none=True)
    tables["plate"].pop("sample_distance_um", None)
    for kind in ("polar", "azimuth"):
        of_kind = [std for name, (_, std, *_) in found.items() if name.startswith(f"{kind} ")]
        if of_kind:
            tables["uncertainty"][f"{kind}_deg"] = min(max(of_kind), _MAX_ANGLE_STD)
    distance = rec.instrument.sample_distance
    name = str(rec.provenance.get("stack", {}).get("source", {}).get("file", "a scan"))
    with atomic_path(path) as part:
        part.write_text(_COMMENT.format(name=" ".join(name.split()), distance=distance) + to_toml(tables), "utf-8")
