"""Designed layouts of apertures against the B-SHeM's, confirmed by traced data on samples that the search has not seen.

    python benchmarks/design.py [--family smooth] [--seen 6] [--members 3] [--draws 3] [--seed 5] [--tiny]

The search (`hx.design`) sees samples of a family of `benchmarks/shapes.py` (one seed); layouts of 3 and 4
apertures at 30 deg incidence, with the total area of the B-SHeM's. The rows: other samples of that family (the next
seed), traced under each layout with equal dose, noise drawn, reconstructed by `refine`: variance of the height errors
and masked area by the tracer's maps, over those of the B-SHeM.
"""

import argparse
import json
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.rows import Row, row, with_origin  # noqa: E402
from benchmarks.shapes import Member, members  # noqa: E402
from helio_jax.arrays import border_mask  # noqa: E402
from helio_jax.instrument import Instrument  # noqa: E402
from helio_jax.planning.design_settings import DesignSettings  # noqa: E402
from helio_jax.workflows import pipeline  # noqa: E402
from helio_jax.workflows.design import design  # noqa: E402
from helio_jax.workflows.design_result import Proposal  # noqa: E402
from helio_jax.workflows.scene_file import SceneFile, load_instrument, load_scene  # noqa: E402
from helio_jax.workflows.truth import true_surface  # noqa: E402

INSTRUMENT = "bshem_wd4"
WANTED_VARIANCE, WANTED_MASKED = 0.67, 0.7


def of_instrument(member: Member, folder: Path) -> SceneFile:
    """Load a member under the B-SHeM instead of its own instrument; the substrate keeps its distance to the spot."""
    tables, instrument = member.tables, load_instrument(INSTRUMENT)
    drop = tables["plate"]["sample_distance_um"] - tables["plate"]["working_distance_um"]
    placed = instrument.at_distance(instrument.working_distance + drop)
    own = placed.model_dump(mode="json", exclude_none=True, exclude_defaults=True)
    return load_scene(replace(member, tables=tables | own).write(folder))


@dataclass(frozen=True)
class Outcome:
    """A sample under one layout.

    Attributes:
        error: of the heights [draw, y, x], um.
        is_valid: in every draw [y, x].
        masked: share of pixels and detectors that are more than half masked, by the tracer.
    """

    error: np.ndarray
    is_valid: np.ndarray
    masked: float


def outcome(scene: SceneFile, instrument: Instrument, draws: int) -> Outcome:
    """Trace a sample under a layout, draw its noise, and reconstruct it."""
    drop = scene.instrument.sample_distance - scene.instrument.working_distance
    placed = instrument.at_distance(instrument.working_distance + drop)
    trace = scene.trace.model_copy(update={"maps": True})
    scene = scene.model_copy(
        update={key: getattr(placed, key) for key in ("beam", "plate", "detector")} | {"trace": trace}
    )
    clean = pipeline.simulate(scene).only()
    assert clean.masked is not None  # trace.maps
    truth, errors = true_surface(scene, clean.x, clean.y).height, []
    is_valid = ~border_mask(truth.shape, 0.06)
    for i in range(draws):
        noise = scene.noise.model_copy(update={"seed": scene.noise.seed + i, "enabled": True})
        stack = pipeline.record(scene.model_copy(update={"noise": noise}), clean).only()
        rec = pipeline.reconstruct(stack, "refine", settings=scene.reconstruct)
        errors.append(rec.height - truth)
        is_valid &= rec.is_valid
    return Outcome(np.array(errors), is_valid, float(np.mean(np.asarray(clean.masked) > 0.5)))


def chosen(proposals: tuple[Proposal, ...]) -> list[Proposal]:
    """Return of every number of apertures the layouts of least variance and of least masked area."""
    out: list[Proposal] = []
    for n in sorted({p.n_apertures for p in proposals}):
        own = [p for p in proposals if p.n_apertures == n]
        for best in (min(own, key=lambda p: p.height_std_um), min(own, key=lambda p: p.masked)):
            out += [best] if best not in out else []
    return out


def describe(p: Proposal) -> str:
    """Return polar angles and azimuths of a layout."""
    return " ".join(f"{polar:.0f}@{azimuth:+.0f}" for polar, azimuth in p.angles_deg)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seen", type=int, default=6, help="samples of the search")
    parser.add_argument("--members", type=int, default=3, help="samples of the rows, which the search has not seen")
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--family", default="smooth")
    parser.add_argument("--size", type=int, default=31)
    parser.add_argument("--pixels", type=int, default=13)
    parser.add_argument("--starts", type=int, default=1)
    parser.add_argument("--steps", type=int, default=25)
    parser.add_argument("--apertures", default="3,4")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--tiny", action="store_true")
    given = parser.parse_args()
    if given.tiny:
        given.seen, given.members, given.draws, given.size = 1, 1, 1, 16
        given.pixels, given.steps, given.apertures = 7, 2, "3"
    size = given.size, given.size
    settings = DesignSettings(
        apertures=tuple(map(int, given.apertures.split(","))), pixels=given.pixels, starts=given.starts,
        steps=given.steps, masked_weights=(0.0,) if given.tiny else (0.0, 1.0),
    )  # fmt: skip
    given.output.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []

    def keep(one: Row) -> None:
        rows.append(one)
        text = json.dumps(with_origin(rows, given.seed), indent=1)
        (given.output / "design.json").write_text(text + "\n", encoding="utf-8")

    with tempfile.TemporaryDirectory() as scratch:
        seen = [of_instrument(m, Path(scratch)) for m in members(given.family, given.seed, range(given.seen), size)]
        unseen_members = list(members(given.family, given.seed + 1, range(given.members), size))
        unseen = [of_instrument(m, Path(scratch)) for m in unseen_members]
        found = design(seen[0], samples=seen[1:], settings=settings, say=lambda text: print(text, flush=True))
        layouts = chosen(found.proposals)
        for i, p in enumerate(layouts, 1):
            what = f"layout {i}: {p.label}, weight {p.masked_weight:g}: {describe(p)}"
            hidden = "-" if p.masked_ratio is None else f"{p.masked_ratio:.2f}"
            value = f"expected variance {p.variance_ratio:.3f}, masked {hidden}, counts {p.count_ratio:.2f}"
            keep(row("1", what, value, "-", None, instrument=p.instrument.model_dump(mode="json")))
        ratios: dict[int, list[float]] = {i: [] for i in range(1, len(layouts) + 1)}
        masked: dict[int, list[tuple[float, float]]] = {i: [] for i in ratios}
        for scene, member in zip(unseen, unseen_members, strict=True):
            outcomes = [outcome(scene, p.instrument, given.draws) for p in (found.reference, *layouts)]
            use = np.logical_and.reduce([o.is_valid for o in outcomes])
            variances = [float(np.mean(o.error[:, use] ** 2)) if use.any() else np.nan for o in outcomes]
            for i, (o, variance) in enumerate(zip(outcomes[1:], variances[1:], strict=True), 1):
                ratio = variance / variances[0]
                ratios[i].append(ratio)
                masked[i].append((o.masked, outcomes[0].masked))
                value = (
                    f"variance {ratio:.2f} ({variances[0] ** 0.5:.2f} -> {variance**0.5:.2f} um), masked "
                    f"{outcomes[0].masked:.1%} -> {o.masked:.1%}, valid {outcomes[0].is_valid.mean():.0%} -> "
                    f"{o.is_valid.mean():.0%}"
                )
                what = f"layout {i}, unseen {member.name}, {member.about['kind']}"
                more = {"variance_ratio": ratio, "masked": o.masked, "masked_of_bshem": outcomes[0].masked}
                keep(row("2", what, value, "-", None, **more))
        for i in ratios:
            variance = float(np.exp(np.mean(np.log(ratios[i]))))
            own, of_bshem = np.sum(masked[i], axis=0)
            share = own / of_bshem if of_bshem else np.nan
            is_reached = bool(variance <= WANTED_VARIANCE or share <= WANTED_MASKED)
            value = f"variance {variance:.2f}, masked area {share:.2f}"
            target = f"<= {WANTED_VARIANCE:g} or <= {WANTED_MASKED:g}"
            keep(row("3", f"layout {i}, all unseen samples", value, target, None if given.tiny else is_reached))


if __name__ == "__main__":
    main()
