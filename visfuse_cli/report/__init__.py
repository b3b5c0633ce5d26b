"""One HTML page about one or several runs, made from nothing but what is in their folders."""

from visfuse_cli.report.page import write

__all__ = ["write"]
