"""What a user knows of the heights (`AnchorSettings`), as sums of heights that a fit takes as data."""

from collections.abc import Sequence

import numpy as np

from helio_jax.errors import SceneError
from helio_jax.forward.optics import Optics, Raster
from helio_jax.forward.surface import Surface
from helio_jax.inverse.anchor_settings import AnchorSettings
from helio_jax.inverse.anchors import Anchors

LEAST_TANGENT = 0.05
"""A mask must grow by at least this much per um of height: the length of a shorter one says little of the height."""


def anchor_name(number: int, stated: AnchorSettings) -> str:
    """Name an anchor as messages show it; numbers count from 0."""
    return stated.name or f"anchor {number + 1}"


def anchors_of(
    stated: Sequence[AnchorSettings],
    raster: Raster,
    optics: Optics,
    surface: Surface,
    detectors: Sequence[str] = (),
) -> Anchors:
    """Express anchors by the heights of pixels.

    Args:
        stated: what is known.
        raster: of the heights.
        optics: of the scan.
        surface: near the one sought: it determines which pixel shows a place to an oblique beam, and where the top is.
        detectors: names of the images, in their order.

    Raises:
        SceneError: a detector that is not there, or one that sees no mask there; a step within one pixel.
    """
    if not stated:
        return Anchors.none(raster.shape)
    weight, value = [], []
    for number, anchor in enumerate(stated):
        places = _Places(f"[[reconstruct.anchor]] {anchor_name(number, anchor)!r}", raster, optics, surface)
        if anchor.kind == "mask":
            sums, known, std = places.mask(anchor, detectors)
        elif anchor.kind == "highest":
            top = np.unravel_index(np.argmax(surface.height), raster.shape)
            at = float(places.x[top]), float(places.y[top])
            sums, known, std = places.mean(at, anchor.radius_um), anchor.height_um, anchor.std_um
        else:
            sums, known, std = places.mean(anchor.at_um, anchor.radius_um), anchor.height_um, anchor.std_um
            if anchor.from_um is not None:
                sums = sums - places.mean(anchor.from_um, anchor.radius_um)
                if np.maximum(sums, 0.0).sum() < 1.0 - 1e-9:
                    raise SceneError(f"{places.name}: the same pixels show at_um and from_um: move them apart")
        assert known is not None  # the settings have checked it
        weight.append(sums / std)
        value.append(known / std)
    return Anchors(np.stack(weight), np.array(value))


def check_places(stated: Sequence[AnchorSettings], raster: Raster, optics: Optics, detectors: Sequence[str]) -> None:
    """Check anchors before any work is done, as far as this is possible without knowing the surface.

    An oblique beam sees a place elsewhere, by its tangent times the height, which is not known yet: up to half of the
    image is allowed for.

    Raises:
        SceneError: as `anchors_of`; a place that the image cannot show.
    """
    anchors_of(stated, raster, optics, Surface(*np.zeros((3, *raster.shape))), detectors)
    for number, anchor in enumerate(stated):
        for key, place in (("at_um", anchor.at_um), ("from_um", anchor.from_um)):
            for axis, value, seen, way in zip("xy", place or (), (raster.x, raster.y), optics.beam_shift, strict=False):
                low, high = float(seen[0]), float(seen[-1])
                room = max((high - low) / max(len(seen) - 1, 1), 0.5 * abs(float(way)) * (high - low))
                if not low - room <= value <= high + room:
                    raise SceneError(
                        f"[[reconstruct.anchor]] {anchor_name(number, anchor)!r}: {key}: {axis} = {value:.6g} um lies "
                        f"outside of the image, which shows {low:.6g} to {high:.6g} um of the substrate: give "
                        "places in the sample frame, as helio measure --profile takes them"
                    )


class _Places:
    """Which pixels see a place of the sample."""

    def __init__(self, name: str, raster: Raster, optics: Optics, surface: Surface) -> None:
        self.name, self.optics, self.height = name, optics, surface.height
        self.step = float(raster.dx), float(raster.dy)
        shift = np.asarray(optics.beam_shift)
        self.x = np.asarray(raster.x)[None, :] - shift[0] * surface.height
        self.y = np.asarray(raster.y)[:, None] - shift[1] * surface.height

    def mean(self, at: tuple[float, float] | np.ndarray | None, radius: float) -> np.ndarray:
        """Return the weights [y, x] of the mean height about a place."""
        assert at is not None  # the settings have checked it
        distance = np.hypot(self.x - at[0], self.y - at[1])
        inside = distance <= max(radius, float(distance.min()))
        return inside / inside.sum()

    def mask(self, anchor: AnchorSettings, detectors: Sequence[str]) -> tuple[np.ndarray, float, float]:
        """Return the weights, height and standard deviation of the edge that casts a mask.

        The centre of the aperture is seen from the end of the mask just above the edge. With the horizontal direction u
        towards it, its polar angle t and the beam's shift b per um of depth, an edge of height h above that end stands
        h tan t away, and appears h (tan t + b u) away in the micrograph. Valid for an aperture that is small as seen
        from there, whose half lies above the edge where half of the signal is back.
        """
        assert anchor.at_um is not None and anchor.length_um is not None  # the settings have checked it
        if anchor.detector is None or anchor.detector not in detectors:
            known = ", ".join(detectors) or "none"
            raise SceneError(f"{self.name}: there is no detector {anchor.detector!r}: detectors are {known}")
        if self.optics.beam_shifts is not None:
            raise SceneError(f"{self.name}: masks of scans of several beams are not taken: state it as a step")
        low = self.mean(anchor.at_um, anchor.radius_um)
        spot = np.array(self.optics.spot(np.asarray(np.sum(low * self.height))))
        across = np.asarray(self.optics.center)[list(detectors).index(anchor.detector)] - spot
        distance = float(np.hypot(*across[:2]))
        tangent, way = distance / float(across[2]), across[:2] / max(distance, 1e-9)
        growth = tangent + float(way @ np.asarray(self.optics.beam_shift))
        if growth < LEAST_TANGENT:
            raise SceneError(
                f"{self.name}: masks of detector {anchor.detector!r} grow by {growth:.2g} um per um of height there, "
                f"{LEAST_TANGENT:g} is the least: take another detector"
            )
        height = anchor.length_um / growth
        edge = np.array(anchor.at_um) + way * (height * tangent + 0.5 * max(self.step))
        return self.mean(edge, anchor.radius_um) - low, height, anchor.std_um / growth
