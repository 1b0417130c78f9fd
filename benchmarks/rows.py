"""Rows of results: printed as a table while they are made, and written as JSON with what made them."""

import json
import os
import platform
import re
from pathlib import Path
from typing import Any

from helio_jax.workflows import provenance

Row = dict[str, object]
PACKAGES = ("helio-jax", "numpy", "jax", "optimistix", "embreex", "numba", "h5py")


def row(number: str, what: str, value: str, target: str, is_reached: bool | None, **more: object) -> Row:
    """Print a row and return it; `is_reached` is None where there is nothing to reach."""
    mark = {True: "yes", False: "NO", None: "-"}[is_reached]
    print(f"{number:>6}  {what:<60} {value:<48} {target:<26} {mark}", flush=True)
    return {"row": number, "what": what, "value": value, "target": target, "reached": is_reached, **more}


def processor() -> str:
    """Return what the processor calls itself, as far as the system tells."""
    try:
        found = re.search(r"model name\s*:\s*(.+)", Path("/proc/cpuinfo").read_text(encoding="utf-8"))
    except OSError:
        found = None
    return found[1] if found else platform.processor() or platform.machine()


def with_origin(rows: list[Any], seed: int) -> dict[str, Any]:
    """Return rows with the commit, machine, its load, versions and seed that they come from."""
    return {
        "git": provenance.git_commit(),
        "machine": {"processor": processor(), "cpus": os.cpu_count(), "load": os.getloadavg()},
        "versions": {name: provenance.package_version(name) for name in PACKAGES},
        "seed": seed,
        "rows": rows,
    }


def write(path: Path, rows: list[Any], seed: int) -> None:
    """Write rows as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(with_origin(rows, seed), indent=1) + "\n")
    print(f"written to {path}")


def update(path: Path, rows: list[Any], seed: int) -> None:
    """Put measured rows into a table of results in place of the rows of the same numbers; each keeps its origin."""
    made = with_origin(rows, seed)
    origin = {"commit": made["git"], "processor": made["machine"]["processor"], "load": made["machine"]["load"][0]}
    fresh = {r["row"] for r in rows}
    kept = [r for r in json.loads(path.read_text())["rows"] if r["row"] not in fresh] if path.exists() else []
    joined = sorted(kept + [r | origin for r in rows], key=lambda r: [int(n) for n in re.findall(r"\d+", r["row"])])
    path.write_text(json.dumps(made | {"git": "see each row", "rows": joined}, indent=1) + "\n")
    print(f"updated {path}")
