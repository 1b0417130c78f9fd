"""Base of every settings model (table of a scene file), and length units.

Field names carry the unit (`_um`, `_deg`, `_mrad`); properties computed from them are in micrometres and radians. Each
setting is declared once, beside the code that uses it; `workflows/scene_file.py` composes the models.
"""

from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, ValidationError

from helio_jax.errors import SceneError

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
            text = "; ".join(f"{'.'.join(map(str, p['loc']))}: {p['msg']}, got {p['input']!r}" for p in e.errors())
            raise SceneError(f"setting not accepted: {text}") from None
