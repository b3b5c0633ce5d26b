"""Imports run one way: cli -> commands -> rooms -> records -> errors, as the parsed code shows."""

import ast
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "visfuse_cli"

# What each room may import of this package, besides itself; a room that is not listed is free.
MAY_IMPORT = {
    "errors": set(),
    "threads": {"errors"},
    "records": {"errors"},
    "maths": {"records", "errors"},
    "vision": {"maths", "records", "errors"},
    "config": {"records", "errors"},
    "files": {"maths", "config", "records", "threads", "errors"},
    "elsewhere": {"threads", "errors"},
    "tracking": {"vision", "maths", "config", "elsewhere", "records", "threads", "errors"},
    "fusing": {"tracking", "vision", "maths", "config", "records", "threads", "errors"},
    "moving": {"vision", "maths", "config", "records", "errors"},
    "gazing": {"moving", "vision", "maths", "config", "records", "errors"},
    "facing": {"vision", "maths", "config", "records", "errors"},
    "pipeline": {"files", "elsewhere", "records", "threads", "errors"},
    "commands": {
        "pipeline",
        "elsewhere",
        "tracking",
        "fusing",
        "facing",
        "moving",
        "gazing",
        "vision",
        "maths",
        "files",
        "evaluate",
        "report",
        "config",
        "records",
        "threads",
        "errors",
    },
    "evaluate": {"maths", "files", "records", "errors"},
    "report": {"maths", "files", "records", "errors"},
    "export": {"files", "records", "errors"},
}
OUTSIDE_OF_MATHS = {"numpy", "scipy"}


def module_files() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def room_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports(path: Path) -> set[str]:
    """Every module that a file imports, at its top or inside functions, relative ones resolved; names of `from` too."""
    package = ["visfuse_cli", *path.relative_to(PACKAGE).parts[:-1]]
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            # `from visfuse_cli.files import video` imports a module of the room `files`
            found |= {f"{module}.{alias.name}" for alias in node.names}
    return found


def inner(path: Path) -> set[tuple[str, ...]]:
    """The parts after `visfuse_cli` of every import of this package."""
    return {tuple(name.split(".")[1:]) for name in imports(path) if name.split(".")[0] == "visfuse_cli"}


@pytest.mark.parametrize("path", module_files(), ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_a_room_imports_only_what_lies_below_it(path: Path):
    room = room_of(path)
    if room not in MAY_IMPORT:
        return
    rooms = {parts[0] for parts in inner(path)} - {room, "__version__"}
    assert rooms <= MAY_IMPORT[room], f"{path.name} ({room}) imports {sorted(rooms - MAY_IMPORT[room])}"


def test_commands_never_import_each_other():
    commands = PACKAGE / "commands"
    names = {path.stem for path in commands.iterdir()} - {"__init__", "__pycache__"}
    for path in sorted(commands.rglob("*.py")):
        own = path.relative_to(commands).with_suffix("").parts[0]
        siblings = {parts[1] for parts in inner(path) if parts[0] == "commands" and len(parts) > 1}
        assert not siblings & (names - {own}), path


def test_maths_stands_on_numpy_and_scipy_alone():
    outside = {}
    for path in sorted((PACKAGE / "maths").glob("*.py")):
        tops = {name.split(".")[0] for name in imports(path)} - {"visfuse_cli"} - set(sys.stdlib_module_names)
        if tops - OUTSIDE_OF_MATHS:
            outside[path.name] = tops - OUTSIDE_OF_MATHS
    assert not outside


def test_nothing_but_the_entry_and_the_apps_imports_the_command_line():
    callers = {room_of(path) for path in module_files() if any(parts[:1] == ("cli",) for parts in inner(path))}
    assert callers <= {"__main__", "cli"}


@pytest.mark.parametrize("path", sorted((PACKAGE / "cli").glob("*.py")), ids=lambda path: path.name)
def test_the_command_line_imports_its_heavy_rooms_inside_functions(path: Path):
    top = ast.parse(path.read_text(encoding="utf-8")).body
    names = {alias.name for node in top if isinstance(node, ast.Import) for alias in node.names}
    names |= {f"{n.module}.{alias.name}" for n in top if isinstance(n, ast.ImportFrom) for alias in n.names}
    heavy = {"cv2", "av", "scipy", "numpy", "pydantic"}
    light = {"visfuse_cli.cli", "visfuse_cli.errors", "visfuse_cli.__version__"}
    ours = {".".join(name.split(".")[:2]) for name in names if name.startswith("visfuse_cli")}
    assert not {name for name in names if name.split(".")[0] in heavy} | (ours - light)
