"""What a study found: scores averaged over repetitions, and as a Markdown table.

The rows of an index are dicts by column. Scores have the names and units of scores/metrics.py; those of micrographs are
made here (`image_scores`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from helio_jax.micrograph import MicrographStack
from helio_jax.scores.metrics import SCORE_ROWS

_IMAGE_SCORES = {
    "mean": "mean counts",
    "contrast": "contrast (s.d. / mean)",
    "multiple": "share of multiple scattering",
    "plate": "share scattered by the plate",
    "masked": "share of masked pixels",
    "middle": "signal, middle over border",
}
"""Labels of the columns `image_scores` makes, which end in _DETECTOR."""
_DEFAULTS = "rms_region", "rms_image", "multiple_*"
_MIDDLE = 0.05
"""The middle of an image is what lies within this share of its sides from the middle, one pixel at least."""


@dataclass(frozen=True)
class Averaged:
    """The runs of one point.

    Attributes:
        values: its case and varied values, by column.
        mean, std: of each score over the runs, in the unit shown; the standard deviation of one run is None.
        n: number of runs that are done.
    """

    values: dict[str, Any]
    mean: dict[str, float]
    std: dict[str, float | None]
    n: int


def image_scores(stack: MicrographStack) -> dict[str, float]:
    """Compute scores of each micrograph, by NAME_DETECTOR.

    Mean counts, contrast (std_dev / mean), shares of multiple scattering, of what the plate scattered, of masked
    pixels, and the mean signal in the middle over the median at the border; only those that are known.
    """
    out: dict[str, float] = {}
    multiple, is_border = stack.multiple, np.ones(stack.shape[1:], bool)
    is_border[1:-1, 1:-1] = False
    offsets = [np.abs(np.arange(n) - 0.5 * (n - 1)) <= max(_MIDDLE * n, 0.5) for n in stack.shape[1:]]
    is_middle = np.outer(*offsets)
    for k, name in enumerate(stack.instrument.detector_names):
        mean, border = float(stack.counts[k].mean()), float(np.median(stack.counts[k][is_border]))
        found = {"mean": mean, "contrast": float(stack.counts[k].std()) / mean if mean else 0.0}
        for part, image in (("multiple", multiple), ("plate", stack.plate)):
            if image is not None:
                found[part] = float(image[k].mean()) / mean if mean else 0.0
        if stack.masked is not None:
            found["masked"] = float(stack.masked[k].mean())
        if border > 0.0:
            found["middle"] = float(stack.counts[k][is_middle].mean()) / border
        out |= {f"{what}_{name}": value for what, value in found.items()}
    return out


def possible_scores(reconstruct: bool, detector_names: Sequence[str], n_views: int) -> list[str]:
    """List the columns of scores that the index of a study may have, by whether it reconstructs heights."""
    if reconstruct:
        return list(SCORE_ROWS)
    views = [f"_view{i}" for i in range(1, n_views + 1)] if n_views > 1 else [""]
    return [f"{what}_{name}{view}" for view in views for name in detector_names for what in _IMAGE_SCORES]


def chosen_scores(wanted: str | list[str] | None, columns: Sequence[str]) -> list[str]:
    """Choose columns of scores: those that match the patterns of a study, or the first default that there is."""
    matching = lambda pattern: [column for column in columns if fnmatchcase(column, pattern)]  # noqa: E731
    if wanted is None:
        return next(filter(None, map(matching, _DEFAULTS)), [])
    patterns = [wanted] if isinstance(wanted, str) else wanted
    return list(dict.fromkeys(column for pattern in patterns for column in matching(pattern)))


def score_label(score: str) -> str:
    """Return the name of a score for people, with its unit."""
    if score in SCORE_ROWS:
        label, unit, _, _ = SCORE_ROWS[score]
        return f"{label} [{unit}]" if unit else label
    what, _, detector = score.partition("_")
    return f"{_IMAGE_SCORES[what]}, '{detector}'" if what in _IMAGE_SCORES else score


def averaged(rows: Sequence[Mapping[str, Any]], keys: Sequence[str], scores: Sequence[str]) -> list[Averaged]:
    """Average the scores of runs that differ in their seeds only; points without one are left out.

    Args:
        rows: of the index.
        keys: columns that tell points from each other.
        scores: columns.
    """
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        if row["status"] == "done":
            groups.setdefault(repr([row[key] for key in keys]), []).append(row)
    return [
        Averaged({key: runs[0][key] for key in keys}, *_moments(runs, scores), len(runs)) for runs in groups.values()
    ]


def _moments(
    runs: Sequence[Mapping[str, Any]], scores: Sequence[str]
) -> tuple[dict[str, float], dict[str, float | None]]:
    """Return mean and standard deviation of each score of some runs, in the unit shown."""
    mean: dict[str, float] = {}
    std: dict[str, float | None] = {}
    for score in scores:
        found = [run[score] for run in runs if isinstance(run.get(score), (int, float))]
        if found:
            values = np.asarray(found) * (SCORE_ROWS[score][2] if score in SCORE_ROWS else 1.0)
            mean[score] = float(values.mean())
            std[score] = float(values.std(ddof=1)) if len(found) > 1 else None
    return mean, std


def table(points: Sequence[Averaged], labels: Mapping[str, str], scores: Sequence[str]) -> str:
    """Return the averages as a Markdown table.

    Args:
        points: of one study.
        labels: of the columns that tell them from each other.
        scores: columns.
    """
    header = [*labels.values(), *map(score_label, scores)]
    body = [[_text(p.values[key]) for key in labels] + [_with_std(p, score) for score in scores] for p in points]
    widths = [max(map(len, column)) for column in zip(header, *body, strict=True)]
    return "\n".join(_lines([header, ["-" * width for width in widths], *body], widths)) + "\n"


def _lines(rows: Sequence[Sequence[str]], widths: Sequence[int]) -> Iterator[str]:
    for row in rows:
        yield "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |"


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _with_std(point: Averaged, score: str) -> str:
    """Write mean and standard deviation."""
    if score not in point.mean:
        return "-"
    std = point.std[score]
    return f"{point.mean[score]:.3g}" if std is None else f"{point.mean[score]:.3g} +- {std:.2g}"
