"""Tables as Parquet, where pyarrow is installed (the extra `parquet`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from visfuse_cli.errors import UsageError
from visfuse_cli.files.atomic import failing_as_output, replacing_path


def write_parquet(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows, None where a column is unknown; raises UsageError without pyarrow, OutputError where it cannot."""
    try:
        import pyarrow as arrow
        import pyarrow.parquet as parquet
    except ImportError as problem:
        raise UsageError("--format parquet needs pyarrow: pip install 'visfuse-cli[parquet]'") from problem
    table = arrow.table({name: arrow.array([row.get(name) for row in rows]) for name in columns})
    with replacing_path(path) as partial, failing_as_output(path):
        parquet.write_table(table, partial)
