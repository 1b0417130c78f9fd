"""Base of every settings model (scene tables): frozen, strict about unknown keys, in user units.

Field names carry the unit (`_um`, `_deg`, `_mrad`); everything computed from them is in micrometres and
radians. Each setting is declared once, in a model beside the code that uses it, with default, range and
meaning; `config.py` only composes these models into a scene file.
"""

from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from helio_jax.errors import SceneError

UNITS_UM = {"nm": 1e-3, "um": 1.0, "mm": 1e3, "cm": 1e4, "m": 1e6, "inch": 25_400.0}
"""Length units of files [um]."""
Unit = Literal["nm", "um", "mm", "cm", "m", "inch"]
"""Name of a length unit of a file."""


class Settings(BaseModel):
    """A frozen table of settings; unknown keys and non-finite numbers are refused."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False, use_attribute_docstrings=True
    )

    def changed(self, **changes: Any) -> Self:
        """Return a copy with some values replaced, checked again; what nobody has set still counts as not set.

        Raises:
            SceneError: an unknown setting, or a value that is out of its range.
        """
        try:
            return type(self).model_validate(self.model_dump(exclude_unset=True) | changes)
        except ValidationError as e:
            told = "; ".join(f"{'.'.join(map(str, p['loc']))}: {p['msg']}, got {p['input']!r}" for p in e.errors())
            raise SceneError(f"setting not accepted: {told}") from None
