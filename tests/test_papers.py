"""Every tag such as `Lou 2002, eq. 11` in the code has its row in PAPERS.md, and every row its code."""

import ast
import re
from pathlib import Path
from typing import NamedTuple

import pytest

PACKAGE = Path(__file__).parents[1] / "visfuse_cli"
YEARS = {"Lou": 2002, "Zhu": 2012, "Jia": 2008, "Wu": 2010, "Bradshaw": 1997}
NUMBER = r"(?:\d+(?:\.\d+)*|[IVX]+)\b"
ITEM = rf"{NUMBER}(?:-{NUMBER})?"
GAP = r"[\s#]+"  # a tag may run over the end of a line of comment
LIST = rf"{ITEM}(?:(?:,| and){GAP}{ITEM})*"
TAG = re.compile(rf"\b({'|'.join(YEARS)}){GAP}(\d{{4}}),{GAP}(eqs?\.|secs?\.|figs?\.|tables?){GAP}({LIST})")
ROW = re.compile(r"^\|(?P<source>[^|]+)\|\s*`(?P<file>[\w/]+\.py)(?::(?P<symbol>[\w.]+))?`\s*\|(?P<note>[^|]*)\|$")


class Place(NamedTuple):
    """One equation, section, figure or table in one function, class or constant (or in a module's docstring)."""

    source: str
    file: str
    symbol: str


def sources(text: str) -> list[tuple[str, int]]:
    """Every source tagged in a text, ranges and lists taken apart: ("Lou 2002, eq. 5", offset)."""
    found = []
    for match in TAG.finditer(text):
        paper, year, kind, items = match.groups()
        kind = kind.replace("s.", ".").replace("tables", "table")
        for item in re.findall(ITEM, items):
            first, _, last = item.partition("-")
            numbers = [str(n) for n in range(int(first), int(last) + 1)] if last.isdigit() else [item]
            found += [(f"{paper} {year}, {kind} {number}", match.start()) for number in numbers]
    return found


def symbols(tree: ast.Module) -> dict[str, tuple[int, int]]:
    """Names defined at the top of a module or of its classes, with their first and last line."""
    spans: dict[str, tuple[int, int]] = {}

    def add(body: list[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
                first = min([node.lineno, *(d.lineno for d in node.decorator_list)])
                spans[prefix + node.name] = (first, node.end_lineno or first)
                if isinstance(node, ast.ClassDef):
                    add(node.body, f"{prefix}{node.name}.")
            elif isinstance(node, ast.Assign | ast.AnnAssign):
                for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                    if isinstance(target, ast.Name) and not prefix:
                        spans[target.id] = (node.lineno, node.end_lineno or node.lineno)

    add(tree.body, "")
    return spans


def owner(spans: dict[str, tuple[int, int]], line: int, docstring_end: int) -> str:
    """The innermost symbol that holds a line; a comment above one belongs to it; empty for the module's docstring."""
    if line <= docstring_end:
        return ""
    inside = [(last - first, name) for name, (first, last) in spans.items() if first <= line <= last]
    if inside:
        return min(inside)[1]
    after = [(first, name) for name, (first, _) in spans.items() if first > line]
    return min(after)[1] if after else ""


def tagged() -> set[Place]:
    places = set()
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        spans = symbols(tree)
        docstring_end = tree.body[0].end_lineno or 0 if ast.get_docstring(tree) else 0
        for source, offset in sources(text):
            line = text.count("\n", 0, offset) + 1
            places.add(Place(source, path.relative_to(PACKAGE).as_posix(), owner(spans, line, docstring_end)))
    return places


def listed() -> set[Place]:
    places = set()
    for line in (PACKAGE / "PAPERS.md").read_text(encoding="utf-8").splitlines():
        row = ROW.match(line)
        if row:
            places |= {Place(s, row["file"], row["symbol"] or "") for s, _ in sources(row["source"])}
    return places


def test_every_tag_in_the_code_has_its_row():
    missing = [f"| {p.source} | `{p.file}{':' * bool(p.symbol)}{p.symbol}` |" for p in sorted(tagged() - listed())]
    assert not missing, "PAPERS.md lacks:\n" + "\n".join(missing)


def test_every_row_names_code_that_is_there():
    gone = []
    for place in sorted(listed()):
        path = PACKAGE / place.file
        if not path.is_file() or (place.symbol and place.symbol not in symbols(ast.parse(path.read_text("utf-8")))):
            gone.append(f"{place.source}: {place.file}:{place.symbol}")
    assert not gone, "PAPERS.md names what is not there:\n" + "\n".join(gone)


def test_every_row_can_be_read():
    lines = (PACKAGE / "PAPERS.md").read_text(encoding="utf-8").splitlines()
    rows = [line for line in lines if line.startswith("|") and "---" not in line and "file:function" not in line]
    assert rows
    unread = [line for line in rows if not (match := ROW.match(line)) or not sources(match["source"])]
    assert not unread, "rows of PAPERS.md that no test can read:\n" + "\n".join(unread)


def test_every_paper_is_cited_with_its_year():
    wrong = [
        place
        for place in tagged() | listed()
        if not place.source.startswith(tuple(f"{p} {y}," for p, y in YEARS.items()))
    ]
    assert not wrong


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("(Lou 2002, eq. 11).", ["Lou 2002, eq. 11"]),
        ("Lou 2002, eqs. 5, 9. Then", ["Lou 2002, eq. 5", "Lou 2002, eq. 9"]),
        ("Jia 2008, eqs. 33-34.", ["Jia 2008, eq. 33", "Jia 2008, eq. 34"]),
        ("Lou 2002,\n    # sec. 2 and 4.1.", ["Lou 2002, sec. 2", "Lou 2002, sec. 4.1"]),
        ("Zhu 2012, tables I, II; sec. V", ["Zhu 2012, table I", "Zhu 2012, table II"]),
        ("Bradshaw 1997, sec. 3.2.1, and I", ["Bradshaw 1997, sec. 3.2.1"]),
        ("as in Wu 2010", []),
    ],
)
def test_tags_are_taken_apart(text: str, expected: list[str]):
    assert [source for source, _ in sources(text)] == expected
