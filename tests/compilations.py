"""Counts what XLA compiles, by the names of the jitted functions; options of what is measured."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from jax import monitoring

EVENT = "/jax/core/compile/backend_compile_duration"
"""What JAX 0.10 tells once for every program it asks XLA for, with `fun_name` "jit(NAME)". Also where the persistent
cache has the program, so counts do not depend on what ran before; not where the process has it in memory."""

OPTIMISED = {"xla_backend_optimization_level": 3, "xla_cpu_use_fusion_emitters": True}
"""Options of `Lowered.compile` for programs whose time or memory is measured: other tests compile without optimisation
(tests/conftest.py)."""


@contextmanager
def counted() -> Iterator[Counter[str]]:
    """Yield a counter that grows by one for each program compiled within the block, of all threads, by its name.

    Operations outside of any jitted function count, too, by the name of their primitive.
    """
    found: Counter[str] = Counter()

    def listen(event: str, seconds: float, **about) -> None:
        if event == EVENT:
            found[str(about.get("fun_name", "?")).removeprefix("jit(").removesuffix(")")] += 1

    monitoring.register_event_duration_secs_listener(listen)
    try:
        yield found
    finally:
        monitoring.unregister_event_duration_listener(listen)
