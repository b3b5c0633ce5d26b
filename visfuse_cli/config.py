"""Strict YAML to frozen models: every mistake is answered with its place and the nearest right key.

This module knows no field names; each command declares its own models on top of `Section`.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from visfuse_cli.errors import UsageError

MAX_BYTES = 1_000_000
Key = tuple[str | int, ...]


class Section(BaseModel):
    """A block of configuration: frozen, and closed to keys it does not know."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


Model = TypeVar("Model", bound=Section)


class _Loader(yaml.SafeLoader):
    """YAML 1.2 scalars on the safe loader: `1e-3` is a number, `on` and `no` are words; no aliases, no twin keys."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.composer.ComposerError(None, None, "aliases (*name) are not allowed", event.start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"key '{key.value}' is given twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


_Loader.yaml_implicit_resolvers = {
    first: [(tag, regexp) for tag, regexp in resolvers if tag.rsplit(":", 1)[1] in {"null"}]
    for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_Loader.add_implicit_resolver("tag:yaml.org,2002:bool", re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$"), "tTfF")
_Loader.add_implicit_resolver("tag:yaml.org,2002:int", re.compile(r"^[-+]?[0-9]+$"), "-+0123456789")
_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(
        r"^[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?$|^[-+]?\.(?:inf|Inf|INF)$|^\.(?:nan|NaN|NAN)$"
    ),
    "-+.0123456789",
)


def parse_yaml(text: str, where: str, error: type[Exception] = UsageError) -> tuple[Any, dict[Key, int]]:
    """Parse one YAML document into plain data and the line of every key; raises `error` with line and column."""
    if len(text.encode("utf-8", "surrogatepass")) > MAX_BYTES:
        raise error(f"{where}: larger than {MAX_BYTES} bytes; not a configuration")
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        data = loader.construct_document(node) if node is not None else None
    except yaml.YAMLError as problem:
        raise error(f"{where}{_mark(problem)}: not valid YAML: {_reason(problem)}") from problem
    except (RecursionError, ValueError) as problem:
        raise error(
            f"{where}: not valid YAML: {type(problem).__name__.lower()}, nested or written beyond reason"
        ) from problem
    finally:
        loader.dispose()
    return data, dict(_lines(node))


def _mark(problem: yaml.YAMLError) -> str:
    mark = getattr(problem, "problem_mark", None)
    return f", line {mark.line + 1}, column {mark.column + 1}" if mark is not None else ""


def _reason(problem: yaml.YAMLError) -> str:
    text = getattr(problem, "problem", None) or getattr(problem, "reason", None) or str(problem)
    return " ".join(str(text).split())


def _lines(node: Any, path: Key = ()) -> Iterable[tuple[Key, int]]:
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            inner = (*path, key.value)
            yield inner, key.start_mark.line + 1
            yield from _lines(value, inner)
    elif isinstance(node, yaml.SequenceNode):
        for index, value in enumerate(node.value):
            yield (*path, index), value.start_mark.line + 1
            yield from _lines(value, (*path, index))


def read_text(path: Path, what: str, error: type[Exception] = UsageError) -> str:
    """Read a small UTF-8 text file; raises `error` naming the file when it cannot be read."""
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise error(f"{path}: larger than {MAX_BYTES} bytes; not {what}")
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        raise error(f"{path}: {what} is not UTF-8 text") from problem
    except OSError as problem:
        raise error(f"{path}: cannot read {what}: {problem.strerror or problem}") from problem


def shipped() -> dict[str, str]:
    """Name and text of every configuration shipped with the package."""
    folder = resources.files("visfuse_cli.configs")
    return {
        entry.name.removesuffix(".yaml"): entry.read_text(encoding="utf-8")
        for entry in sorted(folder.iterdir(), key=lambda e: e.name)
        if entry.name.endswith(".yaml")
    }


def _source(name: str | None) -> tuple[str, str]:
    """Text and display name of `--config NAME`: a file, or the bare name of a shipped configuration."""
    if name is None:
        return "", "defaults"
    path = Path(name)
    if path.suffix == "" and path.name == name and not path.is_file():
        known = shipped()
        if name not in known:
            raise UsageError(
                f"--config {name}: no such file and no shipped configuration{nearest(name, known)}; "
                f"shipped: {', '.join(known)}"
            )
        return known[name], f"{name} (shipped)"
    return read_text(path, "the configuration"), str(path)


def load(model: type[Model], name: str | None = None, overrides: Sequence[str] = ()) -> Model:
    """Build `model` from `--config name` and `--set` overrides; raises UsageError naming key, place and remedy."""
    text, where = _source(name)
    data, lines = parse_yaml(text, where)
    if data is None:
        data = {}
    if not isinstance(data, dict):
        raise UsageError(f"{where}: a configuration is a mapping of keys, not {_kind(data)}")
    origin: dict[Key, str] = {key: f"{where}, line {line}" for key, line in lines.items()}
    for override in overrides:
        key, value = _parse_override(override)
        _put(data, key, value, override)
        origin = {k: v for k, v in origin.items() if k[: len(key)] != key} | {key: f"--set {override}"}
    return validate(model, data, where, origin)


def validate(model: type[Model], data: Mapping[str, Any], where: str, origin: Mapping[Key, str] | None = None) -> Model:
    """Validate plain data against `model`; raises UsageError for the first mistake, with its place."""
    try:
        return model.model_validate(data)
    except ValidationError as problem:
        first = min(problem.errors(), key=lambda e: e["type"] != "extra_forbidden")
        raise UsageError(_explain(model, first, where, origin or {})) from problem


def _parse_override(override: str) -> tuple[Key, Any]:
    key, separator, text = override.partition("=")
    parts = tuple(part.strip() for part in key.split("."))
    if not separator or not all(parts):
        raise UsageError(f"--set {override}: write it as a.b.c=VALUE")
    if text.startswith("%"):  # a time pattern; to YAML it would be a directive
        return parts, text
    value, _ = parse_yaml(text, f"--set {override}")
    return parts, value


def _put(data: dict[str, Any], key: Key, value: Any, override: str) -> None:
    place = data
    for depth, part in enumerate(key[:-1]):
        inner = place.setdefault(str(part), {})
        if inner is None:
            inner = place[str(part)] = {}
        if not isinstance(inner, dict):
            raise UsageError(f"--set {override}: '{'.'.join(map(str, key[: depth + 1]))}' is a value, not a section")
        place = inner
    place[str(key[-1])] = value


def _explain(model: type[Section], error: Any, where: str, origin: Mapping[Key, str]) -> str:
    location: Key = tuple(error["loc"])
    known = location
    while known and known not in origin:
        known = known[:-1]
    inside = next((place for key, place in origin.items() if key[: len(location)] == location), where)
    place = origin.get(known, inside)
    dotted = ".".join(str(part) for part in location) or "the configuration"
    if error["type"] == "extra_forbidden":
        names = _keys_at(model, location[:-1])
        return f"{place}: unknown key '{dotted}'{nearest(str(location[-1]), names)}; known here: {', '.join(names)}"
    got = error.get("input")
    shown = "" if error["type"] == "missing" else f", not {_shorten(got)}"
    reason = error["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    lead = "" if error["type"] in {"value_error", "missing"} else "should be "
    return f"{place}: '{dotted}' {lead}{reason}{shown}".replace("\n", " ")


def _shorten(value: Any) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _kind(value: Any) -> str:
    return "a list" if isinstance(value, list) else "text" if isinstance(value, str) else f"a {type(value).__name__}"


def _keys_at(model: type[BaseModel], path: Key) -> list[str]:
    current: Any = model
    for part in path:
        fields = getattr(current, "model_fields", {})
        if part not in fields:
            break
        current = fields[part].annotation
    return sorted(getattr(current, "model_fields", {}))


def nearest(name: str, known: Iterable[str]) -> str:
    """`; did you mean 'x'?` for the closest of `known`, or nothing."""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f"; did you mean '{close[0]}'?" if close else ""


def dump(config: Section) -> str:
    """The resolved configuration as YAML, in the order the model declares, each key with its description."""
    return "\n".join(_explained(config, "")) + "\n"


def _explained(section: BaseModel, indent: str) -> Iterator[str]:
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            yield f"{indent}{name}:"
            yield from _explained(value, indent + "  ")
            continue
        plain = section.model_dump(mode="json", include={name})
        inner = None if isinstance(plain[name], list | dict) else False  # lists of numbers stay on one line
        text = yaml.safe_dump(plain, sort_keys=False, allow_unicode=True, default_flow_style=inner, width=100)
        lines = [indent + line for line in text.splitlines()]
        if field.description:
            lines[0] += f"  # {field.description}"
        yield from lines


def changed(config: Section) -> list[str]:
    """Dotted keys whose values differ from the defaults."""
    return list(_changed(config, type(config)(), ""))


def _changed(section: BaseModel, default: BaseModel, prefix: str) -> Iterator[str]:
    for name in type(section).model_fields:
        mine, usual = getattr(section, name), getattr(default, name)
        if isinstance(mine, BaseModel) and type(mine) is type(usual):
            yield from _changed(mine, usual, f"{prefix}{name}.")
        elif mine != usual:
            yield f"{prefix}{name}"


def schema(model: type[Section]) -> str:
    """The model's JSON schema, indented."""
    return json.dumps(model.model_json_schema(), indent=2)
