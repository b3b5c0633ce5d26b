"""The documentation follows the tool: keys, commands, links, and a help that is quick and has examples."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from docs.update import keys, updated
from visfuse_cli.cli.app import app
from visfuse_cli.cli.configure import CONFIGURED, model_of
from visfuse_cli.config import dump, load

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
HEAVY = {"cv2", "scipy", "pydantic", "numpy", "av", "matplotlib", "yaml"}


@pytest.mark.parametrize("command", CONFIGURED)
def test_the_keys_of_a_page_are_those_of_the_command(command: str):
    text = (DOCS / f"{command}.md").read_text(encoding="utf-8")
    assert updated(text, command) == text, "run python docs/update.py"
    assert keys(command) in text


@pytest.mark.parametrize("command", CONFIGURED)
def test_what_config_show_prints_is_the_configuration_and_explains_it(command: str, tmp_path: Path):
    model = model_of(command)
    shown = tmp_path / "shown.yaml"
    shown.write_text(dump(model()), encoding="utf-8")
    assert load(model, str(shown)) == model()
    sections = [line for line in shown.read_text().splitlines() if line.startswith(" ") and ":" in line]
    assert sum("  # " in line for line in sections) > len(sections) / 2


def test_links_in_the_documentation_lead_somewhere():
    for page in [ROOT / "README.md", *DOCS.glob("*.md")]:
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def commands() -> dict[str, str]:
    """Every command's help text by its full name."""
    found = {}
    for group in [("", app), *((f"{group.name} ", group.typer_instance) for group in app.registered_groups)]:
        prefix, instance = group
        found |= {prefix + str(each.name): each.callback.__doc__ or "" for each in instance.registered_commands}
    return found


@pytest.mark.parametrize("name", commands())
def test_the_help_of_a_command_has_an_example_and_fits_a_line_of_the_overview(name: str):
    assert f"Example: visfuse {name}" in commands()[name]
    listed = [each for each in app.registered_commands if each.name == name]
    assert all(len(each.short_help or each.callback.__doc__.splitlines()[0]) <= 55 for each in listed)


def test_every_command_is_in_the_documentation():
    text = (DOCS / "README.md").read_text(encoding="utf-8") + (ROOT / "README.md").read_text(encoding="utf-8")
    assert not [name for name in commands() if f"visfuse {name.split()[0]}" not in text]


def test_help_imports_nothing_heavy():
    code = (
        "import sys; sys.argv = ['visfuse', '--help']\n"
        "from visfuse_cli.cli import main\n"
        "try: main()\n"
        "except SystemExit as end: assert end.code == 0\n"
        "print(*sorted({name.split('.')[0] for name in sys.modules}), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "calibrate-homography" in done.stdout
    assert not HEAVY & set(done.stderr.split())


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_shell_completes_commands_and_options(shell: str):
    given = {
        "bash": {"COMP_WORDS": "visfuse fu", "COMP_CWORD": "1"},
        "zsh": {"_TYPER_COMPLETE_ARGS": "visfuse fu"},
        "fish": {"_TYPER_COMPLETE_ARGS": "visfuse fu", "_TYPER_COMPLETE_FISH_ACTION": "get-args"},
    }[shell]
    code = "import sys; sys.argv = ['visfuse']; from visfuse_cli.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=given | {"_VISFUSE_COMPLETE": f"complete_{shell}", "PATH": "/usr/bin"},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert "fuse-cameras" in done.stdout, done.stderr
    assert typer.__version__
