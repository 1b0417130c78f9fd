"""Base of every settings model (scene tables): frozen, strict about unknown keys, in user units.

Field names carry the unit (`_um`, `_deg`, `_mrad`); everything computed from them is in micrometres and
radians. Each setting is declared once, in a model beside the code that uses it, with default, range and
meaning; `config.py` only composes these models into a scene file.
"""

from pydantic import BaseModel, ConfigDict


class Settings(BaseModel):
    """A frozen table of settings; unknown keys and non-finite numbers are refused."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False, use_attribute_docstrings=True
    )
