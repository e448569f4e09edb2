"""What the documentation shows is true: blocks run, generated pages are current, links lead somewhere."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from companion.mission.model import parse_mission

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(path: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", path.read_text(), re.DOTALL)


def test_the_readme_shows_a_picture_by_line_10_and_code_by_line_25():
    lines = (ROOT / "README.md").read_text().splitlines()
    picture = next(k for k, line in enumerate(lines, 1) if line.startswith("!["))
    code = next(k for k, line in enumerate(lines, 1) if line.startswith("```"))
    assert picture <= 10
    assert code <= 25


def test_the_readme_names_its_two_commands_and_the_makefile_has_them():
    shown = "".join(blocks(ROOT / "README.md", "bash"))
    makefile = (ROOT / "Makefile").read_text()
    for target in ("demo", "test"):
        assert f"make {target}" in shown
        assert re.search(rf"^{target}:", makefile, re.MULTILINE)


@pytest.mark.parametrize("text", blocks(ROOT / "README.md", "yaml"))
def test_missions_in_the_readme_are_valid(text):
    assert parse_mission(text, file="README.md").steps


@pytest.mark.parametrize("path", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_python_in_the_documentation_runs(path):
    for text in blocks(path, "python"):
        done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, cwd=ROOT, timeout=300)
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("path", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere(path):
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text()):
        if "://" not in target:
            assert (path.parent / target).exists(), f"{path}: {target}"


def test_generated_pages_are_current():
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    generate = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generate)
    for path, text in generate.pages().items():
        assert path.read_text() == text, f"run: python docs/generate.py  ({path.name})"
