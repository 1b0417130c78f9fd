"""One scan of a known object: its data, what is unknown of it, and where in the vector of all unknowns that stands."""

from dataclasses import dataclass, replace

import numpy as np

from helio_jax.calibration.known_model import ScanModel
from helio_jax.calibration.known_objects import KnownObject
from helio_jax.calibration.noise_model import estimate_noise, find_spikes
from helio_jax.calibration.unknowns import (
    OBJECT,
    PLATE,
    Columns,
    KnownShapeSettings,
    Unknown,
    object_unknowns,
    readout_columns,
)
from helio_jax.errors import SceneError
from helio_jax.forward.optics import Optics, Raster
from helio_jax.instrument import Instrument
from helio_jax.micrograph import MicrographStack

SPIKE = 6.0
"""A pixel that differs from all its neighbours by so many standard deviations is left out."""


@dataclass(frozen=True)
class KnownScan:
    """One scan of a known object: data, model and unknowns of its own.

    Attributes:
        name: of the scan.
        counts, sigma: as read, and their standard deviations [detector, y, x].
        is_used: which are fitted [detector, y, x].
        model: of the detection probability.
        known: the object.
        own: its unknowns, as `unknowns.OBJECT`.
        columns: linear unknowns of the read-out.
        signal: about that of the substrate, in counts [detector].
        slow_axis: of the raster.
        stage: stage position (x, y, height) of the raster's middle [3], um; None: unknown.
        half_width: of the raster in x and y [2], um.
        dwell: dwell time per pixel [s], or None; `unit`: of the counts.
    """

    name: str
    counts: np.ndarray
    sigma: np.ndarray
    is_used: np.ndarray
    model: ScanModel
    known: KnownObject
    own: list[Unknown]
    columns: Columns
    signal: np.ndarray
    slow_axis: int
    stage: np.ndarray | None
    half_width: np.ndarray
    dwell: float | None
    unit: str

    @property
    def n_linear(self) -> int:
        """Gain and other linear unknowns of one detector."""
        return 1 + len(self.columns.names)

    def linear_priors(self, gain: np.ndarray, settings: KnownShapeSettings) -> np.ndarray:
        """Compute the prior standard deviations of the linear unknowns [detector, column]."""
        return np.concatenate(
            [settings.gain * np.abs(gain)[:, None], self.signal[:, None] * self.columns.priors[None]], 1
        )


def prepare_scan(stack: MicrographStack, known: KnownObject, settings: KnownShapeSettings) -> KnownScan:
    """Make a scan ready for the fit: noise, spikes, unknowns.

    Raises:
        SceneError: the stack is a list of positions, or in units of the beam already.
    """
    if stack.positions is not None:
        raise SceneError(f"{stack.name}: a calibration needs a raster, this scan is a list of positions")
    if stack.n_rays is not None and stack.calibration is not None:
        raise SceneError(f"{stack.name}: this scan is calibrated already: give the imported file itself")
    spread = estimate_noise(stack).variance(stack.counts) if stack.noise == "measured" else stack.variance
    if spread is None:
        raise SceneError(f"{stack.name}: the variance of the counts is unknown: import the scan anew")
    spread = np.maximum(spread, 1e-12 * np.nanmax(np.abs(stack.counts)) ** 2)
    used = stack.is_observed & ~find_spikes(stack, spread, SPIKE)
    counts = np.where(stack.is_observed, stack.counts, 0.0)
    reach = 0.5 * float(max(np.ptp(stack.x), np.ptp(stack.y)))
    low, high = np.nanquantile(np.where(used, counts, np.nan).reshape(len(counts), -1), [0.01, 0.6], axis=1)
    slow = 0 if stack.fast_axis == "x" else 1
    middle = np.array([0.5 * (axis[0] + axis[-1]) for axis in (stack.x, stack.y)] + [0.0])
    return KnownScan(
        stack.name,
        counts,
        np.sqrt(spread),
        used,
        ScanModel(Optics.of(stack.instrument), Raster.of(stack), known.kind),
        known,
        object_unknowns(known, reach, settings),
        readout_columns(stack.x, stack.y, slow, settings),
        high - low,
        slow,
        None if stack.stage_position is None else stack.stage_position + middle,
        0.5 * np.array([np.ptp(stack.x), np.ptp(stack.y)]),
        stack.dwell,
        stack.unit,
    )


def one_instrument(stacks: list[MicrographStack]) -> Instrument:
    """Return the instrument that scans state.

    Raises:
        SceneError: they state different ones.
    """
    stated = stacks[0].instrument
    for stack in stacks[1:]:
        if stack.instrument.detector != stated.detector or stack.instrument.plate != stated.plate:
            raise SceneError(
                f"{stack.name}: its instrument is not that of {stacks[0].name}: a joint calibration needs one "
                "instrument; import all scans with the same --instrument"
            )
    return stated


def moved_instrument(stated: Instrument, unknowns: np.ndarray) -> Instrument:
    """Move an instrument by the unknowns of a scan [unknown], um and rad."""
    plate, aim = np.split(unknowns[: -len(OBJECT)], [len(PLATE)])
    return stated.moved(
        aim.reshape(2, -1).T,
        float(plate[4]),
        plate_shift=(float(plate[0]), float(plate[1])),
        scale=1.0 + float(plate[2]),
        rotation=float(plate[3]),
        incidence=float(plate[5]),
    )


class Layout:
    """Where each unknown of each scan stands in the vector of free unknowns."""

    def __init__(self, shared: list[Unknown], scans: list[KnownScan]) -> None:
        n = len(shared)
        self.all = [shared + scan.own for scan in scans]
        free_shared = [i for i, u in enumerate(shared) if u.prior > 0.0]
        self.n_shared = len(free_shared)
        self.unknowns = [shared[i] for i in free_shared]
        self.scan_of = [-1] * self.n_shared
        self.free: list[np.ndarray] = []
        self.place: list[np.ndarray] = []
        for number, scan in enumerate(scans):
            own = [i for i, u in enumerate(scan.own) if u.prior > 0.0]
            start = len(self.unknowns)
            self.free.append(np.array(free_shared + [n + i for i in own]))
            self.place.append(np.array([*range(self.n_shared), *range(start, start + len(own))]))
            self.unknowns += [scan.own[i] for i in own]
            self.scan_of += [number] * len(own)
        several = len(scans) > 1
        self.names = [
            u.name + (f" in {scans[k].name}" if several and k >= 0 else "")
            for u, k in zip(self.unknowns, self.scan_of, strict=True)
        ]
        self.units = [u.unit for u in self.unknowns]
        self.priors = np.array([u.prior for u in self.unknowns])
        self.stated = np.array([u.stated for u in self.unknowns])
        self.scale = np.array([u.prior * u.factor for u in self.unknowns])
        self.start = [
            np.array([0.0 if i < n else u.stated * u.factor for i, u in enumerate(unknowns)]) for unknowns in self.all
        ]

    def of_scan(self, number: int, x: np.ndarray) -> np.ndarray:
        """Compute the unknowns of one scan, um and rad, of free ones in prior standard deviations."""
        out = self.start[number].copy()
        place = self.place[number]
        out[self.free[number]] += (self.scale * x)[place]
        return out


def stride_for(scan: KnownScan, pixels: int) -> int:
    """Return the stride of rows and columns that leaves about so many pixels along the longer side."""
    return max(1, round(max(scan.model.raster.shape) / pixels))


def thinned(scan: KnownScan, stride: int) -> KnownScan:
    """Keep every `stride`-th row and column of a scan."""
    thin = (slice(None), slice(None, None, stride), slice(None, None, stride))
    columns = scan.columns._replace(modes=scan.columns.modes[thin])
    images = {name: getattr(scan, name)[thin] for name in ("counts", "sigma", "is_used")}
    return replace(scan, **images, columns=columns, model=scan.model.thinned(stride))


def linear_start(scan: KnownScan, model: np.ndarray, inverse: np.ndarray, settings: KnownShapeSettings) -> np.ndarray:
    """Solve for gain and the other columns at a given probability [detector, y, x]: [detector, column]."""
    out = []
    for k, image in enumerate(model):
        design = np.concatenate([image[None], scan.columns.modes]).reshape(scan.n_linear, -1) * inverse[k].ravel()
        gain = scan.signal[k] / max(float(np.median(image)), 1e-12)
        weak = np.diag(1.0 / np.concatenate([[3.0 * gain], 10.0 * scan.signal[k] * scan.columns.priors]) ** 2)
        out.append(np.linalg.solve(design @ design.T + weak, design @ (scan.counts[k] * inverse[k]).ravel()))
    return np.array(out)


def expected_counts(scan: KnownScan, linear: np.ndarray, model: np.ndarray) -> np.ndarray:
    """Compute the readings [detector, y, x] of linear unknowns [detector, column] at probabilities [detector, y, x]."""
    return linear[:, 0, None, None] * model + np.tensordot(linear[:, 1:], scan.columns.modes, 1)


@dataclass(frozen=True)
class InstrumentFit:
    """An instrument that was fitted to scans of known objects.

    Attributes:
        instrument: as fitted; `stated`: as given.
        scans: the data.
        names, units, stated_values, priors, values, stds: of the free unknowns, in the units shown.
        covariance: of the free unknowns over their prior standard deviations, enlarged for misfit.
        n_shared: of them are those of the instrument, the first ones.
    """

    instrument: Instrument
    stated: Instrument
    scans: list[KnownScan]
    names: list[str]
    units: list[str]
    stated_values: np.ndarray
    priors: np.ndarray
    values: np.ndarray
    stds: np.ndarray
    covariance: np.ndarray
    n_shared: int
