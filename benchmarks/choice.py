"""Which of a benchmark's tables are run: those that its command line names, or all."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping


def run(about: str | None, tables: Mapping[str, Callable[[int], None]], option: str, default: int) -> None:
    """Run the tables that are asked for, each with the number that `option` gives."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="*", metavar="table", help=f"of {', '.join(tables)}; all without one")
    parser.add_argument(option, type=int, default=default, dest="number")
    args = parser.parse_args()
    unknown = sorted(set(args.tables) - set(tables))
    if unknown:
        parser.error(f"no table {unknown[0]}; there are {', '.join(tables)}")
    for name in args.tables or tables:
        tables[name](args.number)
        print()
