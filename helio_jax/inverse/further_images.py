"""Further images of a fitted surface that are not recorded yet: what they would show, and how noisy they would be.

The fit's problem is posed anew with images of other orientations, whose data are those expected of the fitted surface,
masks and multiple scattering included. Their noise is that of the recorded images of the same detector at the same
signal. Nothing is fitted here.
"""

from dataclasses import replace

import numpy as np

from helio_jax.forward.optics import Raster
from helio_jax.inverse.explanations import scan_order
from helio_jax.inverse.fit import Fit
from helio_jax.inverse.geometry_score import usual_uncertainty
from helio_jax.inverse.linear import parallax_of, signal_of
from helio_jax.inverse.parameters import NAMES, Parameters
from helio_jax.inverse.problem import FitProblem
from helio_jax.inverse.state import FitState, Predict, update_corrections
from helio_jax.inverse.steps import expected
from helio_jax.micrograph import MicrographStack

_LEAST_SHARE = 0.02
"""Least variance of the counts of one second, in the median of the recorded data's: no datum is taken for exact."""


def with_further_images(
    fit: Fit, stack: MicrographStack, predict: Predict, seconds: np.ndarray, detector: np.ndarray
) -> tuple[FitProblem, FitState]:
    """Pose the problem of a fit with further images, and put it into the fitted state.

    Args:
        fit: of the first images of the stack.
        stack: these images, and after them the further ones with any counts; observed where a pixel would be seen.
        predict: masks and multiple scattering of all of its images.
        seconds: dwell time of every datum [detector, y, x]; of the further images: that their noise is computed for.
        detector: number of the image among the first ones whose noise each further image has [image].

    Returns:
        The problem, whose further data are those expected of the fitted surface, and its state.
    """
    n = fit.problem.signal.shape[0]
    signal, variance = signal_of(stack)
    signal[:n], variance[:n] = fit.problem.signal, fit.problem.variance
    surface, known, is_fitted = fit.state.surface, fit.problem, fit.is_geometry_fitted
    parallax = parallax_of(stack)
    if parallax is not None:
        parallax[0][:n] = known.parallax
    problem = FitProblem.of(
        signal,
        variance,
        stack.instrument,
        Raster.of(stack),
        surface,
        known.reconstruct_settings,
        known.region,
        scan_order(stack),
        patches=known.patches,
        anchors=known.anchors,
        parallax=parallax,
        uncertainty=usual_uncertainty(known) if is_fitted else None,
    )
    problem = replace(
        problem, held_level=known.held_level, slope_noise=known.slope_noise, noise_share=known.noise_share
    )
    parameters = _extended(problem, fit.state.parameters, detector if is_fitted else None)
    state = update_corrections(problem, FitState.at(problem, surface, parameters), predict)
    model = expected(problem, state, is_noisy=True)
    further = np.where(problem.is_observed[n:], model[n:], np.nan)
    per_second = noise_of_signal(known.signal, known.variance * seconds[:n], further, detector)
    prediction = state.held.sigma**2 - problem.variance
    signal[n:], variance[n:] = further, per_second / seconds[n:]
    changes = {"signal": signal, "variance": variance}
    if parallax is not None:
        changes["parallax"] = problem.parallax.copy()
        changes["parallax"][n:] = [
            parallax_of_image(image, surface.height, problem.raster, shift)
            for image, shift in zip(further, np.asarray(stack.instrument.beam_shifts)[n:], strict=True)
        ]
    problem = replace(problem, **changes)
    sigma = np.where(problem.is_observed, np.sqrt(variance + np.maximum(prediction, 0.0)), np.inf)
    residuals = np.zeros(signal.shape)
    residuals[:n] = np.where(problem.is_observed[:n], (model - problem.data)[:n] / sigma[:n], 0.0)
    return problem, replace(state, held=replace(state.held, sigma=sigma), residuals=residuals)


def noise_of_signal(
    signal: np.ndarray, per_second: np.ndarray, further: np.ndarray, detector: np.ndarray
) -> np.ndarray:
    """Compute the variance of the counts of one second that further images would have.

    A straight line, constant + slope * signal with neither negative, is fitted to each recorded image.

    Args:
        signal, per_second: of the recorded images, and their variance in one second [detector, y, x], NaN: unknown.
        further: signals expected of further images [image, y, x].
        detector: number of the recorded image that each is like [image].
    """
    out = np.empty(further.shape)
    for i, k in enumerate(detector):
        known = np.isfinite(signal[k]) & np.isfinite(per_second[k])
        x, y = signal[k][known], per_second[k][known]
        best = np.inf
        for columns in ((0, 1), (1,), (0,)):
            basis, line = np.stack([np.ones_like(x), x], 1), np.zeros(2)
            line[list(columns)] = np.linalg.lstsq(basis[:, list(columns)], y, rcond=None)[0]
            misfit = float(np.sum((y - basis @ line) ** 2))
            if np.all(line >= 0.0) and misfit < best:
                best, out[i] = misfit, line[0] + line[1] * further[i]
        out[i] = np.maximum(out[i], _LEAST_SHARE * np.median(y))
    return out


def parallax_of_image(image: np.ndarray, height: np.ndarray, raster: Raster, shift: np.ndarray) -> np.ndarray:
    """Compute how a scan's image changes per um that the surface is higher, where its beam meets the surface [y, x].

    The point r of a surface h is seen at r + h s, so that the gradient g of the scan's image follows from that of the
    image on the surface, G = (1 + grad h s^T) g. Source: own derivation.

    Args:
        image: on the surface [y, x]; NaN: not seen.
        height: of the surface [y, x], um.
        raster: of both.
        shift: of the beam, in the frame of the raster [2].
    """
    known = np.isfinite(image)
    image = np.where(known, image, np.nanmedian(image) if known.any() else 0.0)
    (down, along), (rise_y, rise_x) = (np.gradient(f, raster.y, raster.x) for f in (image, height))
    # s . g of the rank-one system, by Sherman and Morrison
    stretch = 1.0 + rise_x * shift[0] + rise_y * shift[1]
    change = (shift[0] * along + shift[1] * down) / np.where(np.abs(stretch) > 0.1, stretch, 0.1)
    return np.where(known, change, 0.0)


def _extended(problem: FitProblem, parameters: Parameters, alike: np.ndarray | None) -> Parameters:
    """Give the further images' parameters their prior means, and keep those of the first ones.

    `alike`: number of the image whose aperture each further one has, which keeps the direction that was fitted; None:
    prior means.
    """
    start = problem.stated_parameters()
    values = {}
    for name in NAMES:
        old, new = np.asarray(getattr(parameters, name)), np.array(getattr(start, name), float)
        if old.shape == new.shape:
            new = old
        elif old.ndim and new.ndim == old.ndim and old.shape[1:] == new.shape[1:]:
            new[: len(old)] = old
            if name == "aim" and alike is not None:
                new[len(old) :] = old[alike]
        values[name] = new
    return Parameters(**values)
