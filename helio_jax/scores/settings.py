"""Known shape of the sample and scoring region: table `[truth]`."""

from pydantic import Field

from helio_jax.settings import Settings


class TruthSettings(Settings):
    """Regions of the sample that are scored (by the position of the true first hit on the sample)."""

    region_center_um: tuple[float, float] = (0.0, 0.0)
    """Axis (x, y) of the structure [um]."""
    region_radius_um: float | None = Field(default=None, gt=0.0, le=1e6)
    """The structure: true first hits within this distance of the axis; default: the whole image [um]."""
    substrate_radius_um: float | None = Field(default=None, gt=0.0, le=1e6)
    """The substrate: true first hits beyond this distance; its median height sets the level [um]."""
    height_um: float | None = Field(default=None, gt=0.0, le=1e6)
    """Height that errors are divided by; default: the sample's highest point [um]."""
