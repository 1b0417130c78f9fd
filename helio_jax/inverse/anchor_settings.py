"""What a user knows of the heights: tables `[[reconstruct.anchor]]`, or lines of a CSV file (`--anchors`)."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from helio_jax.settings import Settings

NEEDED = {
    "height": {"at_um", "height_um"},
    "step": {"at_um", "from_um", "height_um"},
    "mask": {"at_um", "length_um", "detector"},
    "highest": {"height_um"},
}
"""Keys that each kind of anchor needs; beside them all take `name`, `std_um` and `radius_um`."""
Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]


class AnchorSettings(Settings):
    """One thing that is known of the heights: table `[[reconstruct.anchor]]`; used by `refine`."""

    name: str = Field(default="", max_length=80)
    """Shown in messages and the report; default: its number."""
    kind: Literal["height", "step", "mask", "highest"] = "height"
    """`height` of a place; `step`: height of a place above another one (0: both are level with one another); `mask`:
    height of an edge, from the length of the mask that it casts; `highest`: height of the highest point."""
    at_um: tuple[Coordinate, Coordinate] | None = None
    """Place (x, y) in the sample frame [um]; of a mask: its end, where half of the signal is back."""
    from_um: tuple[Coordinate, Coordinate] | None = None
    """`step`: the place (x, y) above which its height counts [um]."""
    radius_um: float = Field(default=0.0, ge=0.0, le=1e5)
    """The height is the mean within this radius of each place [um]; default: that of the nearest pixel."""
    height_um: float | None = Field(default=None, ge=-1e5, le=1e5)
    """Above the substrate; with a free border above the plane at the instrument's distance [um]."""
    length_um: float | None = Field(default=None, gt=0.0, le=1e5)
    """`mask`: distance in the micrograph from the edge to the end of the mask, along the detector's direction [um]."""
    std_um: float = Field(gt=0.0, le=1e5)
    """Standard deviation of the height or of the length [um]."""
    detector: str | None = None
    """`mask`: the detector that the edge hides."""

    @model_validator(mode="after")
    def _has_what_it_needs(self) -> "AnchorSettings":
        needed = NEEDED[self.kind]
        given = {key for key in set().union(*NEEDED.values()) if getattr(self, key) is not None}
        if missing := needed - given:
            raise ValueError(f"an anchor of kind {self.kind!r} needs {', '.join(sorted(missing))}")
        if surplus := given - needed:
            raise ValueError(f"an anchor of kind {self.kind!r} takes no {', '.join(sorted(surplus))}")
        return self
