"""Rows of results: printed as a table while they are made, and written as JSON with what made them."""

import json
import os
import platform
from pathlib import Path
from typing import Any

from helio_jax import provenance

Row = dict[str, object]
PACKAGES = ("helio-jax", "numpy", "jax", "optimistix", "embreex", "numba", "h5py")


def row(number: str, what: str, value: str, target: str, is_reached: bool | None, **more: object) -> Row:
    """Print a row and return it; `is_reached` is None where there is nothing to reach."""
    mark = {True: "yes", False: "NO", None: "-"}[is_reached]
    print(f"{number:>6}  {what:<60} {value:<48} {target:<26} {mark}", flush=True)
    return {"row": number, "what": what, "value": value, "target": target, "reached": is_reached, **more}


def with_origin(rows: list[Any], seed: int) -> dict[str, Any]:
    """Return rows with the commit, machine, its load, versions and seed that they come from."""
    return {
        "git": provenance.git_commit(),
        "machine": {"processor": platform.machine(), "cpus": os.cpu_count(), "load": os.getloadavg()},
        "versions": {name: provenance.package_version(name) for name in PACKAGES},
        "seed": seed,
        "rows": rows,
    }


def write(path: Path, rows: list[Any], seed: int) -> None:
    """Write rows as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(with_origin(rows, seed), indent=1) + "\n")
    print(f"written to {path}")
