"""What every record can do for a reader: `plot()`, a short `repr`, a notebook view; `to_xarray()` of those on a raster.

Records lie below figures and formats and may not import them. These functions are therefore found by name when they
are first called, as the public names of the package are; no other module does so (tests/test_architecture.py).
"""

import importlib
from typing import Any

_DRAW = "helio_jax.workflows.show"
_NOTEBOOK = "helio_jax.figures.notebook"
_XARRAY = "helio_jax.formats.as_xarray"


class Drawable:
    """Base of records that can be drawn."""

    def plot(self, **options: Any) -> Any:
        """Draw the record as a matplotlib figure, which a notebook shows; see `helio_jax.workflows.show.draw`.

        Args:
            options: `common_scale=True` (micrographs: one grey scale), `view=1` (scene: which view of the scan).
        """
        return importlib.import_module(_DRAW).draw(self, **options)

    def __repr__(self) -> str:
        """Return the record in one line, e.g. <MicrographStack 'a': 3 x 121 x 121, expected counts>."""
        return f"<{type(self).__name__} {self._in_short()}>"

    __str__ = __repr__

    def _in_short(self) -> str:
        """Return the line's content."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        """Return a thumbnail and a table, for notebooks."""
        return importlib.import_module(_NOTEBOOK).as_html(self)


class OnRaster(Drawable):
    """Base of records of arrays on one raster."""

    def to_xarray(self, invalid: str = "nan") -> Any:
        """Return the record as an xarray.Dataset; see `helio_jax.formats.as_xarray.to_xarray`.

        Args:
            invalid: what becomes of missing values: "nan", "keep" or "fill".

        Raises:
            MissingDependencyError: xarray is not installed: pip install 'helio-jax[xarray]'.
        """
        return importlib.import_module(_XARRAY).to_xarray(self, invalid)
