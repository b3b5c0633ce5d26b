"""The one family of expected failures, each with its exit code; `cli.entry` is the only place that catches it.

A message says what is wrong, where (file, line, column or key), and what would be right, in one line.
"""


class VisfuseError(Exception):
    """Base of every failure that is reported as one line on stderr."""

    exit_code = 1


class UsageError(VisfuseError):
    """The command line, `--config` or `--set` is wrong."""

    exit_code = 2


class InputError(VisfuseError):
    """An input is missing, unreadable or not what it should be."""

    exit_code = 3


class OutputError(VisfuseError):
    """An output cannot be written, or its folder is not empty."""

    exit_code = 4


class BusyError(VisfuseError):
    """Another run holds this output."""

    exit_code = 75
