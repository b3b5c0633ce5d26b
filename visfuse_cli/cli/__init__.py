"""The command line: thin, and lazy in its imports."""

from visfuse_cli.cli.entry import main

__all__ = ["main"]
