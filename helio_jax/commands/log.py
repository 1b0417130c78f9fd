"""The log file of a command (`--log FILE`): what was run, by which version, every message and warning with its time."""

import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

NAME = "helio_jax"
"""Name of the logger; nothing is logged, and logging is not imported, without `--log`."""


def log(text: str, is_warning: bool = False) -> None:
    """Add a message to the log file of the running command, if it has one."""
    if (logging := sys.modules.get("logging")) is not None and (logger := logging.getLogger(NAME)).handlers:
        # without a handler, logging would print warnings to stderr by itself
        logger.log(logging.WARNING if is_warning else logging.INFO, text)


@contextmanager
def logged(path: Path | None) -> Iterator[None]:
    """Append to a log file what happens in the block: the command, messages, Python's warnings, and how it ended."""
    if path is None:
        yield
        return
    import logging

    from helio_jax import __version__

    handler = _handler_class()(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(message)s"))
    loggers = logging.getLogger(NAME), logging.getLogger("py.warnings")
    level, start = loggers[0].level, time.perf_counter()
    for logger in loggers:
        logger.addHandler(handler)
    loggers[0].setLevel(logging.INFO)
    logging.captureWarnings(True)
    try:
        log(f"helio_jax {__version__}, Python {sys.version.split()[0]}, in {Path.cwd()}: {shlex.join(sys.argv)}")
        yield
        log(f"ended well after {time.perf_counter() - start:.1f} s")
    except BaseException as e:
        code = getattr(e, "exit_code", 130 if isinstance(e, KeyboardInterrupt) else 1)
        log(
            f"ended with exit code {code} after {time.perf_counter() - start:.1f} s: {e or type(e).__name__}", code != 0
        )
        raise
    finally:
        logging.captureWarnings(False)
        loggers[0].setLevel(level)
        for logger in loggers:
            logger.removeHandler(handler)
        handler.close()


def _handler_class() -> Any:
    """Return the class of the handler; logging is imported with the first log file only."""
    import logging

    class Handler(logging.FileHandler):
        """Writes to the file; a full disk costs the log, not the command."""

        def handleError(self, record: Any) -> None:
            self.close()
            logging.getLogger(NAME).removeHandler(self)
            print(f"warning: the log {self.baseFilename} cannot be written: {sys.exc_info()[1]}", file=sys.stderr)

    return Handler
