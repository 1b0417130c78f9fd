"""Texture parameters of reconstructed heights against those of the true surface, all pixels counted.

python benchmarks/texture.py [--output benchmarks/out] [--seeds 1,2] [--tiny]

Simulated scene `rough` with counting noise, reconstructed by nearfield and by refine; without filters, and between an
S-filter of 70 um and an L-filter of 300 um.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import helio_jax as hx  # noqa: E402
from benchmarks.rows import Row, row, write  # noqa: E402
from helio_jax.workflows.pipeline import record  # noqa: E402

FILTERS: dict[str, dict[str, float]] = {"no filter": {}, "70 to 300 um": {"s_filter_um": 70.0, "l_filter_um": 300.0}}
NAMES = ("Sq", "Sdq", "Sk", "Sal")


def texture_rows(seed: int, size: tuple[int, int] | None) -> list[Row]:
    """Compare the parameters of both methods with the true ones for one seed of tracer and noise."""
    changes, refine = {"trace.seed": seed, "noise.seed": seed}, {}
    if size:
        changes |= {"scan.nx": size[0], "scan.ny": size[1], "trace.rays": 16}
        refine = {"max_rounds": 2, "rays": 20_000, "samples": 8}
    scene = hx.load_scene(ROOT / "scenes" / "rough.toml", changes)
    stack = record(scene, hx.simulate(scene))
    rows = []
    for method in ("nearfield", "refine"):
        rec = hx.reconstruct(stack, method, refine=refine)
        rec = rec.replace(is_valid=np.ones(rec.height.shape, bool))
        true = rec.replace(height=hx.true_height(scene, rec).height, height_samples=None, height_std=None)
        for label, filters in FILTERS.items():
            found, exact = hx.measure_texture(rec, **filters), hx.measure_texture(true, **filters)
            errors = {name: getattr(found, name) / getattr(exact, name) - 1.0 for name in NAMES}
            stated = {name: found.parameters[name].std / getattr(exact, name) for name in NAMES}
            value = ", ".join(f"{name} {errors[name]:+.1%} ({stated[name]:.1%})" for name in NAMES)
            what = f"{method}, {label}: error (stated s.d.)"
            rows.append(row(f"{seed}", what, value, "", None, errors=errors, stated=stated))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--output", type=Path, default=ROOT / "benchmarks" / "out")
    parser.add_argument("--seeds", default="1,2")
    parser.add_argument("--tiny", action="store_true")
    args = parser.parse_args()
    seeds = [1] if args.tiny else [int(s) for s in args.seeds.split(",")]
    rows = [r for seed in seeds for r in texture_rows(seed, (19, 21) if args.tiny else None)]
    write(args.output / ("texture_tiny.json" if args.tiny else "texture.json"), rows, seed=seeds[0])


if __name__ == "__main__":
    main()
