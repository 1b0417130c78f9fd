"""Export micrographs and heights to other programs; heights on request on a regular grid of the sample frame."""

import os
from typing import Literal

from helio_jax.errors import SceneError
from helio_jax.formats import export as formats
from helio_jax.heightmap import HeightMap
from helio_jax.measure.sample_grid import resample_heights
from helio_jax.micrograph import MicrographSet, MicrographStack
from helio_jax.reconstruction import Reconstruction


def export(
    obj: MicrographStack | MicrographSet | Reconstruction | HeightMap,
    path: str | os.PathLike,
    *,
    view: int | None = None,
    detector: str | None = None,
    invalid: Literal["nan", "keep", "fill"] = "nan",
    grid: float | None = None,
) -> list[str]:
    """Write micrographs or heights to a file of another program. What each suffix can hold: docs/exports.md.

    Args:
        obj: result of `read`, `simulate` or `reconstruct`, or a height map.
        path: target file; its suffix selects the format.
        view: index of the stack in a set, from 0; required for several stacks.
        detector: name of the only detector to write; required where the format holds one image.
        invalid: what becomes of heights that are not valid and counts that were not observed: "nan": missing values;
            "keep": written as they are; "fill": interpolated from their neighbours.
        grid: pitch of a regular grid in the sample frame, onto which heights are resampled [um]; None: the raster.

    Returns:
        Data of the object that the file does not hold, each with a reason.

    Raises:
        SceneError: the format is unknown, or cannot hold this object; the file cannot be written.
        GuardError: no height is valid, so that none can be resampled.

    Example:
        >>> hx.export(rec, "height.x3p")
    """
    left_out = []
    if grid is not None:
        if not isinstance(obj, Reconstruction):
            raise SceneError(f"{path}: --grid resamples reconstructed heights, this is a {type(obj).__name__}")
        left_out = [f"albedo, normals, residuals, reasons: they belong to the raster, not to the grid of {grid:g} um"]
        obj = resample_heights(obj, grid, use_all=invalid == "keep")
    return formats.export(obj, path, view=view, detector=detector, invalid=invalid) + left_out
