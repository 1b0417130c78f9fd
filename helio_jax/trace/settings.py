"""Settings of the Monte Carlo tracer: table `[trace]`. Read by the command line without importing the tracer."""

from typing import Literal

from pydantic import Field, model_validator

from helio_jax.settings import Settings

MAX_BRANCHES = 1024
"""Most paths from one first hit."""


class TraceSettings(Settings):
    """How a scene is traced."""

    rays: int = Field(default=256, ge=8, le=10_000_000)
    """Beam rays per pixel; the counts do not depend on it (see scan.atoms_per_pixel), only their error does."""
    target_error: float | None = Field(default=None, gt=0.0, lt=1.0)
    """Wanted standard error of every detector in every pixel, as a share of its count: pixels that need more than
    `rays` get more, up to `max_rays`; default: `rays` everywhere."""
    target_atoms: float | None = Field(default=None, gt=0.0, le=1e15)
    """Wanted instead: every scattering order that is kept apart at least as well known, in every detector and pixel, as
    counting this many beam atoms would tell (35000: the reference program's usual number)."""
    max_rays: int = Field(default=4096, ge=8, le=10_000_000)
    """Most beam rays per pixel where there is a target; dark pixels take as many, so a lower cap saves time."""
    branches: int = Field(default=8, ge=1, le=MAX_BRANCHES)
    """`expected`: paths followed from the first hit of every beam ray, for the multiple scattering."""
    estimator: Literal["expected", "analog"] = "expected"
    """`expected`: closed-form direct term and next-event estimation; `analog`: whole counts of detected rays."""
    seed: int = Field(default=1, ge=0, lt=2**63)
    """Seed; the same seed gives the same counts, whatever ran them."""
    max_events: int = Field(default=50, ge=1, le=10_000)
    """A ray is stopped, and counted as stopped, after this many hits of the sample or the plate."""
    n_orders: int = Field(default=4, ge=1, le=64)
    """Scattering orders kept apart; the last one holds "and above"."""
    paths_per_unit: int = Field(default=4_000_000, ge=1)
    """Paths (rays times branches) in a unit of work, the most that a killed worker loses: a few seconds of tracing."""
    workers: int | None = Field(default=None, ge=1, le=4096)
    """Threads (or processes); default: one per CPU."""
    maps: bool = True
    """Also make the masking and shadowing maps (never under a plate of kind "mesh")."""

    @property
    def has_target(self) -> bool:
        """Whether pixels get as many rays as they need."""
        return self.target_error is not None or self.target_atoms is not None

    @model_validator(mode="after")
    def _has_a_target_it_can_reach(self) -> "TraceSettings":
        if not self.has_target:
            return self
        if self.target_error is not None and self.target_atoms is not None:
            raise ValueError("target_error and target_atoms are two ways to say one thing: remove one of both")
        name = "target_atoms" if self.target_error is None else "target_error"
        if self.estimator == "analog":
            raise ValueError(
                f"{name} needs estimator = 'expected': analog counts are those of `rays` atoms in every pixel; "
                "remove one of both"
            )
        if self.max_rays < self.rays:
            raise ValueError(f"max_rays must be >= rays = {self.rays}, got {self.max_rays}: raise it")
        return self
