"""Entry point of the command line `helio` (= `python -m helio_jax`)."""

import sys
import traceback

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
from helio_jax.errors import HelioError
from helio_jax.workflows.compilation_cache import keep_compiled


def main(args: list[str] | None = None) -> None:
    """Run the command line and end the process with an exit code of errors.py."""
    keep_compiled()
    try:
        app(args=args, standalone_mode=True)
    except HelioError as e:
        say(f"helio: {e}")
        sys.exit(e.exit_code)
    except KeyboardInterrupt:
        say("helio: interrupted; files written so far are complete")
        sys.exit(130)
    except BrokenPipeError:
        sys.exit(0)
    except Exception:
        traceback.print_exc()
        say("helio: this is a bug; please report it with the message above and the scene")
        sys.exit(1)


if __name__ == "__main__":
    main()
