"""`python -m visfuse_cli` is the `visfuse` command."""

import os
import signal
from types import FrameType


def _leave(number: int, frame: FrameType | None) -> None:
    """End at once, as long as there is nothing to finish and Python would print where it was."""
    os.write(2, b"visfuse: interrupted\n" if number == signal.SIGINT else b"visfuse: terminated\n")
    os._exit(128 + number)


def main() -> None:
    """Import the command line, which takes a moment, and run it."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _leave)
    from visfuse_cli.cli import main as run

    run()


if __name__ == "__main__":
    main()
