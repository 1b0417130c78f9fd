"""Base of every settings model (table of a scene file), and length units.

Field names carry the unit (`_um`, `_deg`, `_mrad`); properties computed from them are in micrometres and radians. Each
setting is declared once, beside the code that uses it; `workflows/scene_file.py` composes the models.
"""

from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from helio_jax.errors import SceneError
from helio_jax.spelling import did_you_mean

UNITS_UM = {"nm": 1e-3, "um": 1.0, "mm": 1e3, "cm": 1e4, "m": 1e6, "inch": 25_400.0}
"""Length units of files [um]."""
Unit = Literal["nm", "um", "mm", "cm", "m", "inch"]
"""Name of a length unit of a file."""


class Settings(BaseModel):
    """A frozen table of settings that refuses unknown keys and non-finite numbers."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    def changed(self, **changes: Any) -> Self:
        """Return a validated copy with some values replaced; fields that were not set stay unset.

        Raises:
            SceneError: an unknown setting, or a value that is out of its range.
        """
        try:
            return type(self).model_validate(self.model_dump(exclude_unset=True) | changes)
        except ValidationError as e:
            raise SceneError(f"setting not accepted: {in_one_line(e, type(self))}") from None


def in_one_line(e: ValidationError, model: type[Settings]) -> str:
    """Say in one line what is wrong with the settings of a model: place, rule and value of each error."""
    return "; ".join(_explain(model, problem) for problem in e.errors())


def _explain(model: type[Settings], problem: Any) -> str:
    """Format one of pydantic's errors; an unknown setting gets its nearest name, or the table that it belongs to."""
    where, value = ".".join(map(str, problem["loc"])), problem["input"]
    if problem["type"] != "extra_forbidden":
        return f"{where}: {problem['msg']}, got {value!r}"
    *above, key = problem["loc"]
    for part in above:
        model = _tables(model).get(part, Settings)
    for name, table in _tables(model).items():
        if key in table.model_fields:
            return f"{where}: belongs to {name!r}: give it as {name}={{{key!r}: {value!r}}}"
    remedy = did_you_mean(key, model.model_fields) or f"known are {', '.join(model.model_fields)}"
    return f"{where}: there is no such setting: {remedy}"


def _tables(model: type[Settings]) -> dict[str, type[Settings]]:
    """Return the settings of a model that are tables themselves."""
    hints = {name: field.annotation for name, field in model.model_fields.items()}
    return {name: hint for name, hint in hints.items() if isinstance(hint, type) and issubclass(hint, Settings)}
