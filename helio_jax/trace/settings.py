"""Settings of the Monte Carlo tracer: table `[trace]`. Imports no numba, for a fast command line."""

from typing import Literal

from pydantic import Field, model_validator

from helio_jax.settings import Settings

MAX_BRANCHES = 1024
"""Limit of paths from one first hit."""


class TraceSettings(Settings):
    """Settings of the tracer."""

    rays: int = Field(default=256, ge=8, le=10_000_000)
    """Beam rays per pixel; they determine the error of the counts, not the counts (see scan.atoms_per_pixel)."""
    target_error: float | None = Field(default=None, gt=0.0, lt=1.0)
    """Target relative standard error in each detector and pixel: pixels get between `rays` and `max_rays` rays;
    default: `rays` everywhere."""
    target_atoms: float | None = Field(default=None, gt=0.0, le=1e15)
    """Alternative target: the standard error of each scattering order (up to `n_orders`), detector and pixel that an
    analog count of this many beam atoms would have (35000: usual number of the reference program)."""
    max_rays: int = Field(default=4096, ge=8, le=10_000_000)
    """Limit of beam rays per pixel with a target; dark pixels reach it, so a lower limit saves time."""
    branches: int = Field(default=8, ge=1, le=MAX_BRANCHES)
    """`expected`: paths from the first hit of each beam ray, for the multiple scattering."""
    estimator: Literal["expected", "analog"] = "expected"
    """`expected`: closed-form single scattering and next-event estimation; `analog`: counts of detected rays."""
    seed: int = Field(default=1, ge=0, lt=2**63)
    """Seed; equal seeds give equal counts for any number of workers."""
    max_events: int = Field(default=50, ge=1, le=10_000)
    """A ray is counted as stopped after this many hits of the sample or the plate."""
    n_orders: int = Field(default=4, ge=1, le=64)
    """Scattering orders in the output; the last one includes all higher ones."""
    paths_per_unit: int = Field(default=4_000_000, ge=1)
    """Paths (rays times branches) per unit of work, a few seconds of tracing; a killed worker loses one unit."""
    workers: int | None = Field(default=None, ge=1, le=4096)
    """Threads (or processes); default: one per CPU."""
    maps: bool = True
    """Compute masking and shadowing maps, too (never with a plate of kind "mesh")."""

    @property
    def has_target(self) -> bool:
        """Whether the number of rays is adaptive."""
        return self.target_error is not None or self.target_atoms is not None

    @model_validator(mode="after")
    def _check_target(self) -> "TraceSettings":
        if not self.has_target:
            return self
        if self.target_error is not None and self.target_atoms is not None:
            raise ValueError("target_error and target_atoms exclude each other: remove one of them")
        name = "target_atoms" if self.target_error is None else "target_error"
        if self.estimator == "analog":
            raise ValueError(
                f"{name} needs estimator = 'expected': an analog run has `rays` atoms in each pixel; remove one of them"
            )
        if self.max_rays < self.rays:
            raise ValueError(f"max_rays must be >= rays = {self.rays}, got {self.max_rays}: raise it")
        return self
