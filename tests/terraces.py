"""Traced test scenes: terraces with vertical walls, turned by any angle, with numbers drawn at random."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from helio_jax.workflows import pipeline
from helio_jax.workflows.scene_file import load_scene

ROOT = Path(__file__).resolve().parents[1]
OUTLINES = {
    "square": ["aaa", "aaa", "aaa"],
    "L": ["aaa", "a..", "a.."],
    "T": ["aaa", ".a.", ".a."],
    "ring": ["aaaaa", "a...a", "a...a", "a...a", "aaaaa"],
    "two": ["aaa", "aba", "aaa"],
    "sides": ["ab"],
}
"""Cells of each outline, rows from below; "a": height 1, "b": height 2 of the two, ".": substrate."""


def terrace_mesh(x: np.ndarray, y: np.ndarray, level: np.ndarray) -> trimesh.Trimesh:
    """Build an open sheet of level cells joined by vertical walls; x [n + 1], y [m + 1], level [m, n], um."""
    quads = []
    for i, j in np.ndindex(level.shape):
        (x0, x1), (y0, y1), z = x[j : j + 2], y[i : i + 2], level[i, j]
        quads.append([(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)])
    cuts = np.unique(level)
    for low, high in itertools.pairwise(cuts):
        is_up = level > 0.5 * (low + high)
        for i, j in np.argwhere(is_up[:, 1:] != is_up[:, :-1]):
            at, a, b = x[j + 1], y[i], y[i + 1]
            a, b = (a, b) if is_up[i, j] else (b, a)
            quads.append([(at, a, low), (at, b, low), (at, b, high), (at, a, high)])
        for i, j in np.argwhere(is_up[1:] != is_up[:-1]):
            at, a, b = y[i + 1], x[j], x[j + 1]
            a, b = (b, a) if is_up[i, j] else (a, b)
            quads.append([(a, at, low), (b, at, low), (b, at, high), (a, at, high)])
    vertices = np.array(quads).reshape(-1, 3)
    first = 4 * np.arange(len(quads))[:, None]
    faces = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])
    return trimesh.Trimesh(vertices, faces)


def terraces(outline: str, width: float, heights: tuple[float, float], size: float = 6000.0) -> trimesh.Trimesh:
    """Build one of `OUTLINES`, `width` um wide, in a square substrate of side `size`."""
    rows = OUTLINES[outline]
    level = np.array([[{".": 0.0, "a": heights[0], "b": heights[1]}[c] for c in row] for row in rows])
    m, n = level.shape
    cell = width / max(m, n)
    x, y = (cell * (np.arange(k + 1) - 0.5 * k) for k in (n, m))
    x, y = (np.concatenate([[-0.5 * size], a, [0.5 * size]]) for a in (x, y))
    return terrace_mesh(x, y, np.pad(level, 1))


def draw(rng: np.random.Generator, **fixed: Any) -> dict[str, Any]:
    """Draw a member: outline, sign, incidence, raster, width, height, turn, place, SNR."""
    outline = str(rng.choice(list(OUTLINES)))
    n = int(rng.integers(61, 102))
    pixel = float(rng.uniform(6.0, 14.0))
    width = float(rng.uniform(0.3, 0.5)) * n * pixel
    sign = 1.0 if outline in ("two", "sides", "ring") else float(rng.choice([1.0, -1.0]))
    member = {
        "outline": outline,
        "n": n,
        "pixel": pixel,
        "incidence": float(rng.choice([0.0, 30.0])),
        "width": width,
        "height": sign * float(rng.uniform(0.1, 0.6)) * width,
        "second": float(rng.uniform(0.3, 0.7)),
        "turn": float(rng.uniform(0.0, 360.0)),
        "place": tuple(rng.uniform(-1.0, 1.0, 2) * pixel),
        "snr": float(np.exp(rng.uniform(np.log(30.0), np.log(100.0)))),
        "seed": int(rng.integers(1 << 30)),
    } | fixed
    if member["outline"] in ("two", "sides"):  # the height is that of the upper level
        member["levels"] = (member["height"] * member["second"], member["height"])
    else:
        member["levels"] = (member["height"], member["height"])
    return member


def trace(member: dict[str, Any], folder: Path, rays: int = 256) -> Any:
    """Simulate a member and add Poisson noise; return the stack."""
    mesh = folder / "terraces.stl"
    terraces(member["outline"], member["width"], member["levels"]).export(mesh)
    center = 0.5 * max(member["height"], 0.0) * np.tan(np.radians(member["incidence"]))
    x, y = member["place"]
    scene = folder / "scene.toml"
    text = (ROOT / "scenes" / "instruments" / "bshem_wd4.toml").read_text()
    text = text.replace("incidence_deg = 30.0 ", f"incidence_deg = {member['incidence']} ")
    scene.write_text(
        f"""{text}
[sample]
kind = "mesh"
file = "{mesh.name}"
unit = "um"
rotate_deg = [0.0, 0.0, {member["turn"]}]
translate_um = [{x - center}, {y}, 0.0]

[scan]
nx = {member["n"]}
ny = {member["n"]}
pixel_size_um = {member["pixel"]}
atoms_per_pixel = {member["snr"] ** 2 / 0.0165}

[trace]
rays = {rays}
seed = {member["seed"] % 1000}

[noise]
seed = {member["seed"]}
"""
    )
    loaded = load_scene(scene)
    return pipeline.record(loaded, pipeline.simulate(loaded))


def seen_level(member: dict[str, Any], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Compute the level that the beam sees at beam positions x, y [um]; NaN on walls."""
    rows = OUTLINES[member["outline"]]
    level = np.array([[{".": 0.0, "a": member["levels"][0], "b": member["levels"][1]}[c] for c in row] for row in rows])
    cell, turn = member["width"] / max(level.shape), np.radians(member["turn"])
    tan = np.tan(np.radians(member["incidence"]))
    (x0, y0), shift = member["place"], 0.5 * max(member["height"], 0.0) * tan
    out = np.full(np.shape(x), np.nan)
    for z in sorted({0.0, *level.ravel().tolist()}):  # a higher level lies above what is behind it
        u, v = x - z * tan - (x0 - shift), y - y0
        column = np.floor((np.cos(turn) * u + np.sin(turn) * v) / cell + 0.5 * level.shape[1]).astype(int)
        line = np.floor((np.cos(turn) * v - np.sin(turn) * u) / cell + 0.5 * level.shape[0]).astype(int)
        inside = (column >= 0) & (column < level.shape[1]) & (line >= 0) & (line < level.shape[0])
        here = level[np.clip(line, 0, level.shape[0] - 1), np.clip(column, 0, level.shape[1] - 1)]
        out = np.where(np.where(inside, here, 0.0) == z, z, out)
    return out
