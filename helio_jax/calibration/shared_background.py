"""The background that scans of one measuring campaign share: taken from calibrated scans, predicted for another one.

A polynomial over the stage remains one in any other window, so that scans of different places are joined exactly.
"""

import math
from typing import NamedTuple

import numpy as np

from helio_jax.calibration.known_shape import KnownFit
from helio_jax.campaign import CampaignReadout, DetectorReadout
from helio_jax.errors import SceneError
from helio_jax.forward.readout import pedestal_modes
from helio_jax.micrograph import MicrographStack

_U, _V = np.meshgrid(*[np.linspace(-1.0, 1.0, 12)] * 2)
"""Places in a window, in units of half of it, at which a polynomial is expanded in the shapes of another window."""


class SharedBackground(NamedTuple):
    """Background of a scan as predicted from its campaign, in the unit of its counts.

    Attributes:
        signal: of the level substrate [detector].
        mean: expected background [detector, y, x].
        level_std: standard deviation of its mean over the image [detector].
        shape_std: root mean square standard deviation of what remains without that mean [detector].
        is_placed: whether the stage positions of both are known; if not, `mean` has no shape.
        raised: height of the stage above that of the calibrated scans, um; 0 where it is unknown.
    """

    signal: np.ndarray
    mean: np.ndarray
    level_std: np.ndarray
    shape_std: np.ndarray
    is_placed: bool
    raised: float


def _shapes(u: np.ndarray, v: np.ndarray, degree: int) -> np.ndarray:
    """Compute the shapes of a background, the constant first [mode, ...], at places in units of half a window."""
    constant = np.ones((1, *u.shape))
    return np.concatenate([constant, pedestal_modes(u, v, degree)[0]]) if degree else constant


def campaign_readout(fit: KnownFit, signals: np.ndarray) -> CampaignReadout:
    """Join the read-outs that a calibration found in its scans.

    Scans whose stage position is known are joined over the smallest window that holds all of them, each by its
    covariance; if that of one is unknown, the first scan alone is taken.

    Args:
        fit: of known shapes.
        signals: of the substrate, above the background [scan, detector], counts.
    """
    scans = list(fit.scans)
    is_placed = all(scan.stage is not None for scan in scans)
    is_alike = len({(scan.dwell, scan.unit) for scan in scans}) == 1
    scans = scans if is_placed and is_alike else scans[:1]
    centers = [np.zeros(2) if scan.stage is None else scan.stage[:2] for scan in scans]
    low = np.min([c - s.half_width for c, s in zip(centers, scans, strict=True)], 0)
    high = np.max([c + s.half_width for c, s in zip(centers, scans, strict=True)], 0)
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    names = scans[0].columns.names
    columns = [i for i, name in enumerate(names) if name == "offset" or name.startswith("pedestal")]
    degree = next(d for d in range(10) if (d + 1) * (d + 2) // 2 == len(columns))
    rows = [1 + i for i in columns]  # the gain comes first
    changes = []  # own amplitudes of common ones
    for scan, center in zip(scans, centers, strict=True):
        u, v = ((center[a] + p * scan.half_width[a] - middle[a]) / half[a] for a, p in enumerate((_U, _V)))
        common, own = (_shapes(*at, degree).reshape(len(rows), -1) for at in ((u, v), (_U, _V)))
        changes.append(np.linalg.lstsq(own.T, common.T, rcond=None)[0])
    detectors = []
    for k, name in enumerate(fit.instrument.detector_names):
        information, vector = np.zeros((len(rows), len(rows))), np.zeros(len(rows))
        for i, change in enumerate(changes):
            weight = np.linalg.inv(fit.linear_covariance[i][k][np.ix_(rows, rows)])
            information += change.T @ weight @ change
            vector += change.T @ weight @ fit.linear[i][k, rows]
        covariance = np.linalg.inv(information)
        std = np.sqrt(np.diag(covariance))
        detectors.append(
            DetectorReadout(
                name=name,
                signal=float(f"{np.mean(signals[: len(scans), k]):.5g}"),
                background=tuple((covariance @ vector).tolist()),
                std=tuple(float(f"{s:.3g}") for s in std),
                correlation=tuple(tuple(row) for row in np.round(covariance / np.outer(std, std), 3).tolist()),
            )
        )
    return CampaignReadout(
        unit=scans[0].unit,
        dwell_s=scans[0].dwell,
        window_um=(float(half[0]), float(half[1])),
        stage_um=None if scans[0].stage is None else (float(middle[0]), float(middle[1]), float(scans[0].stage[2])),
        degree=degree,
        detector=tuple(detectors),
    )


def shared_background(stack: MicrographStack, readout: CampaignReadout) -> SharedBackground:
    """Predict the background of a measured scan.

    Where the stage position of the scan or of the campaign is unknown, the mean background is expected everywhere, and
    its spread over the campaign's window is part of the standard deviations.

    Raises:
        SceneError: the read-out is of other detectors or of another unit.
    """
    by_name = {d.name: d for d in readout.detector}
    missing = [name for name in stack.instrument.detector_names if name not in by_name]
    if missing or stack.unit != readout.unit:
        what = f"not of detector {missing[0]!r}" if missing else f"in {readout.unit!r}, the scan in {stack.unit!r}"
        raise SceneError(
            f"{stack.name}: readout of the instrument is {what}: calibrate anew (helio calibrate --known), or remove "
            "the table [readout] and import again"
        )
    found = [by_name[name] for name in stack.instrument.detector_names]
    scale = stack.dwell / readout.dwell_s if stack.dwell and readout.dwell_s else 1.0
    shape, means, levels, spreads = stack.shape[1:], [], [], []
    u, v, is_placed, raised = _U, _V, False, 0.0
    if stack.stage_position is not None and readout.stage_um is not None:
        place = np.array([*np.meshgrid(stack.x, stack.y)]) + stack.stage_position[:2, None, None]
        u, v = (place[a] - readout.stage_um[a] for a in range(2))
        u, v = u / readout.window_um[0], v / readout.window_um[1]
        is_placed, raised = True, float(stack.stage_position[2] - readout.stage_um[2])
    design = _shapes(u, v, readout.degree).reshape(-1, u.size)
    for d in found:
        covariance, expected = d.covariance(), np.array(d.background) @ design
        average = design.mean(1)
        rest = design - average[:, None]
        level, spread = average @ covariance @ average, float(np.mean(np.sum(rest * (covariance @ rest), 0)))
        if not is_placed:
            level, spread = level + float(np.var(expected)), spread + float(np.var(expected))
            expected = np.full(shape, expected.mean())
        means.append(expected.reshape(shape))
        levels.append(math.sqrt(max(level, 0.0)))
        spreads.append(math.sqrt(max(spread, 0.0)))
    signal = np.array([d.signal for d in found])
    return SharedBackground(
        scale * signal, scale * np.array(means), scale * np.array(levels), scale * np.array(spreads), is_placed, raised
    )
