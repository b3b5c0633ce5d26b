"""Bring the tables of configuration keys in these pages up to date: `python docs/update.py`; a test holds them so."""

from __future__ import annotations

import re
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from visfuse_cli.cli.configure import CONFIGURED, model_of
from visfuse_cli.config import shipped

HERE = Path(__file__).parent
BEGIN, END = "<!-- keys: made by update.py -->", "<!-- end of keys -->"
BOUNDS = {"ge": "at least {}", "gt": "above {}", "le": "at most {}", "lt": "below {}", "min_length": "{} or more"}


def keys(command: str) -> str:
    """The configuration of a command as a Markdown table: key, default, what it may be, what it is for."""
    rows = ["| key | default | may be | what it is for |", "|---|---|---|---|"]
    rows += [f"| `{key}` | {default} | {kind} | {why} |" for key, default, kind, why in _rows(model_of(command), "")]
    return "\n".join(rows)


def _rows(model: type[BaseModel], prefix: str) -> Iterator[tuple[str, str, str, str]]:
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from _rows(field.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name, _default(field), _kind(field), _cell(field.description or "")


def _default(field: FieldInfo) -> str:
    value = field.get_default(call_default_factory=True)
    if value is PydanticUndefined:
        return "none: it must be given"
    if isinstance(value, tuple) and any(isinstance(each, BaseModel) for each in value):
        return ", ".join(str(getattr(each, "name", each)) for each in value)
    return "" if value is None else f"`{str(value).lower() if isinstance(value, bool) else _plain(value)}`"


def _plain(value: Any) -> str:
    return f"[{', '.join(map(_plain, value))}]" if isinstance(value, tuple | list) else str(value)


def _kind(field: FieldInfo) -> str:
    told = [
        text.format(f"{bound:g}" if isinstance(bound, float) else bound)
        for each in field.metadata
        for name, text in BOUNDS.items()
        if (bound := getattr(each, name, None)) is not None
    ]
    return _cell(", ".join([_type(field.annotation), *told]))


def _type(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(kind))
    if get_origin(kind) in (Union, types.UnionType):
        return " or ".join(_type(each) for each in get_args(kind) if each is not type(None))
    if get_origin(kind) in (tuple, list):
        inner = get_args(kind)
        return "list" if Ellipsis in inner or len(inner) < 2 else f"{len(inner)} numbers"
    names = {bool: "`true`, `false`", int: "whole number", float: "number", str: "text", Path: "file"}
    return names.get(kind, "names and values" if get_origin(kind) is dict else "text")


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def updated(text: str, command: str) -> str:
    """A page with its table of keys as the models say; raises ValueError where the page has no place for it."""
    if not re.search(f"{re.escape(BEGIN)}.*{re.escape(END)}", text, flags=re.DOTALL):
        raise ValueError(f"{command}.md: has no {BEGIN} ... {END}")
    names = [name for name in shipped() if _suits(name, command)]
    known = f"Shipped for this command: {', '.join(f'`--config {name}`' for name in names)}.\n\n" if names else ""
    made = f"{BEGIN}\n{known}{keys(command)}\n{END}"
    return re.sub(f"{re.escape(BEGIN)}.*{re.escape(END)}", lambda _: made, text, flags=re.DOTALL)


def _suits(name: str, command: str) -> bool:
    """Whether a shipped configuration is for a command: its first line names it."""
    return bool(re.search(rf"visfuse {command}\b", shipped()[name].splitlines()[0]))


def main() -> None:
    """Rewrite every page of a command that has a configuration."""
    for command in CONFIGURED:
        page = HERE / f"{command}.md"
        page.write_text(updated(page.read_text(encoding="utf-8"), command), encoding="utf-8")


if __name__ == "__main__":
    main()
