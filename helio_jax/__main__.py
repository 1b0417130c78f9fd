"""Entry point of the command line `helio` (= `python -m helio_jax`)."""

import errno
import sys
import traceback
from typing import NoReturn

try:
    from helio_jax.commands import (  # noqa: F401 (each registers its commands)
        about,
        heights,
        looking,
        measured,
        planning,
        scenes,
        simulating,
    )
    from helio_jax.commands.app import app, say
    from helio_jax.commands.interrupts import INTERRUPTED, not_lost
    from helio_jax.errors import HelioError
except KeyboardInterrupt:  # before anything was begun
    sys.exit(130)

DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)
"""A disk that is full, over quota, read-only or broken, and a file that may not grow."""


def main(args: list[str] | None = None) -> None:
    """Run the command line and end the process with an exit code of errors.py."""
    try:
        with not_lost():
            app(args=args, standalone_mode=True)
    except HelioError as e:
        say(f"helio: {e}")
        sys.exit(e.exit_code)
    except KeyboardInterrupt:
        say(INTERRUPTED)
        sys.exit(130)
    except BrokenPipeError:
        sys.exit(0)
    except OSError as e:
        if e.errno not in DISK_ERRORS:
            raise_as_bug()
        say(f"helio: {e.filename or 'the output'} cannot be written: {e.strerror}; make room, or write elsewhere")
        sys.exit(2)
    except Exception:
        raise_as_bug()


def raise_as_bug() -> NoReturn:
    """Print the traceback of the current exception and end with exit code 1."""
    traceback.print_exc()
    say("helio: this is a bug; please report it with the message above and the scene")
    sys.exit(1)


if __name__ == "__main__":
    main()
