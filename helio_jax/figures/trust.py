"""How far a height map is to be trusted, in words: the verdict, the share and rule of valid heights, what limits it.

One wording for terminal, panel, notebook and report. The rule itself is `validity.VALID_RULE`.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from helio_jax.figures.wording import share
from helio_jax.reconstruction import Reconstruction
from helio_jax.validity import CONTRADICTED, contradicted_share

GOOD, CARE, BAD = "supported", "with care", "not to be trusted"
"""The three verdicts."""
COLORS = {GOOD: "#1a6b3a", CARE: "#8a5a00", BAD: "#b00020"}
"""Their colours, readable on white."""
_MOST = 4
"""Limits that are listed at most."""


def verdict(rec: Reconstruction) -> tuple[str, str]:
    """Return one of the three verdicts, and a sentence with its reason."""
    if not rec.is_valid.any():
        causes = rec.trust["not_valid"]
        worst = max(causes, key=lambda reason: causes[reason], default="no data")
        return BAD, f"no height is valid; main reason: {worst} ({share(causes.get(worst, 1.0))} of the pixels)"
    if rec.is_contradicted:
        part = share(contradicted_share(rec.reason))
        return BAD, f"micrographs traced on it deviate from the data in {part} of the otherwise valid pixels"
    if rec.chi_square is None:
        return CARE, "no micrographs were traced on this height map, so that the data have not tested it"
    part = share(1.0 - contradicted_share(rec.reason))
    agree = f"micrographs traced on it agree with the data in {part} of the otherwise valid pixels"
    if rec.warnings:
        return CARE, f"{agree}, but {rec.warnings[0]}"
    return GOOD, agree


def verdict_text(rec: Reconstruction) -> str:
    """Write the verdict as one text."""
    return ": ".join(verdict(rec))


def trust_rows(trust: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Write what is valid, by which rule, and why the rest is not (of `Reconstruction.trust`)."""
    causes = [f"{reason} {share(part)}" for reason, part in trust["not_valid"].items()]
    rows = [("valid", f"{share(trust['valid_share'])} of the pixels: {trust['valid_rule']}")]
    return rows + ([("not valid", ", ".join(causes))] if causes else [])


def trust_lines(trust: Mapping[str, Any]) -> list[str]:
    """Write the same as lines for the terminal."""
    return [f"{label}: {text}" for label, text in trust_rows(trust)]


def limits(rec: Reconstruction) -> list[str]:
    """List what limits the trust in a height map, the largest effects first."""
    found = [text for text in rec.warnings if text != CONTRADICTED]
    causes = sorted(rec.trust["not_valid"].items(), key=lambda item: -item[1])
    found += [f"{reason} in {share(part)} of the pixels" for reason, part in causes[:1]]
    if rec.height_std is None:
        found.append("the method gives no error bars")
    found += [f"{name}: {um:.3g} um of the highest point" for name, um in error_sources(rec)[:1]]
    common = numbers(rec.provenance, "instrument").get("common_mode_um", 0.0)
    if common > 0:
        found.append(f"an error common to all heights of up to {common:.3g} um")
    return found[:_MOST] or ["nothing that the method reports"]


def error_sources(rec: Reconstruction) -> list[tuple[str, float]]:
    """List by how much each gain and offset leaves the highest point uncertain [um], the largest first.

    The change of the highest point per change of the signal (`sensitivity`) times the posterior standard deviation.
    """
    effect, known = numbers(rec.provenance, "sensitivity"), table(rec.provenance, "instrument", "values")
    finite = rec.height[np.isfinite(rec.height)]
    top = float(np.abs(finite - np.median(finite)).max()) if finite.size else 0.0
    found = [
        (name.removeprefix("log_"), abs(factor * std) * top)
        for name, factor in effect.items()
        if (std := _std(known.get(name)))
    ]
    return sorted(found, key=lambda item: -item[1])


def discrepancy_text(rec: Reconstruction) -> str:
    """Say what the model was found to lack in each detector's image (`Uncertainty.discrepancy`); "": nothing is known.

    Root mean squares over the median signal.
    """
    found = numbers(rec.provenance, "instrument", "discrepancy")
    stated = numbers(rec.provenance, "instrument").get("discrepancy_std", 0.0)
    parts = ", ".join(f"{rms:.1%} ({name})" for name, rms in found.items())
    return f"smooth errors of the model: {parts} of the signal, stated {stated:.1%}" if parts else ""


ANCHOR_TITLES = "anchor", "stated or measured (um)", "in the map (um)", "without it (um)", "difference (s.d.)", ""
"""Of the columns of `anchor_rows`."""


def anchor_rows(rec: Reconstruction) -> list[tuple[str, ...]]:
    """Write what each anchor states, or mask bands measure, what the map has there, and what all else says.

    Of the records of `AnchorCheck`.
    """
    found = table(rec.provenance).get("anchors")
    rows = []
    for one in found if isinstance(found, list) else []:
        value, about = numbers(one), table(one)
        if value.keys() >= {"stated", "stated_std", "fitted", "without", "without_std", "pull"}:
            stated = f"{value['stated']:.5g} +- {value['stated_std']:.2g}"
            without = f"{value['without']:.5g} +- {value['without_std']:.2g}"
            agrees = "" if about.get("agrees") else "does not agree, see the warning"
            name = f"{about.get('name')} ({about.get('kind')})"
            rows.append((name, stated, f"{value['fitted']:.5g}", without, f"{value['pull']:+.1f}", agrees))
    return rows


def anchor_lines(rec: Reconstruction) -> list[str]:
    """Write the same as lines for the terminal."""
    return [
        f"  {name}: {stated} um, in the map {fitted}, without it {without}, {pull} s.d. apart"
        + (f"; {agrees}" if agrees else "")
        for name, stated, fitted, without, pull, agrees in anchor_rows(rec)
    ]


def _std(values: Any) -> float:
    """Return the standard deviation in a record (value, s.d., prior s.d., unit); 0 if it is none."""
    is_record = isinstance(values, (list, tuple)) and len(values) == 4 and isinstance(values[1], (int, float))
    return float(values[1]) if is_record else 0.0


def table(values: Any, *path: str) -> dict[str, Any]:
    """Return a table within tables of a history; an empty one if it is not there or no table."""
    for name in path:
        values = values.get(name) if isinstance(values, Mapping) else None
    return dict(values) if isinstance(values, Mapping) else {}


def numbers(values: Any, *path: str) -> dict[str, float]:
    """Return the finite numbers of such a table."""
    return {
        str(name): float(value)
        for name, value in table(values, *path).items()
        if isinstance(value, (int, float)) and np.isfinite(value)
    }
