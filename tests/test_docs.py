"""The documentation is true: links lead somewhere, commands and settings exist, code runs, the README stays short."""

from __future__ import annotations

import ast
import importlib
import os
import re
import shlex
import shutil
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml
from command_line import ok

import hybridlio as hl
from docs.make_pages import FROM_ELSEWHERE, made_pages
from hybridlio.commands.app import app

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
README = ROOT / "README.md"
PAGES = [README, *(ROOT / file for file in FROM_ELSEWHERE.values()), *sorted(DOCS.rglob("*.md"))]
MADE = {DOCS / name: text for name, text in made_pages().items()}
MAX_README_WORDS = 900
NOT_RUN = "# not run"


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def text_of(page: Path) -> str:
    """The text of a page; pages that are made while the site is built are made here."""
    return MADE.get(page) or page.read_text()


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), flags=re.DOTALL | re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, by the usual rule: lower case, no punctuation, hyphens for spaces."""
    headings = re.findall(r"^#+ (.+)$", text_of(page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_link_leads_somewhere(page: Path):
    dead = []
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if link.startswith("https://"):
            continue
        path, _, anchor = link.partition("#")
        target = Path(os.path.normpath(page.parent / path)) if path else page
        if not (target.exists() or target in MADE) or (anchor and anchor not in anchors(target)):
            dead.append(link)
    assert dead == []


def is_defined(name: str) -> bool:
    """Whether a dotted name is that of a module, or of something in a module."""
    parts = name.split(".")
    for k in range(len(parts), 0, -1):
        module = ".".join(parts[:k])
        try:
            found = importlib.import_module(module)
        except ModuleNotFoundError:
            continue
        return all((found := getattr(found, part, None)) is not None for part in parts[k:])
    return False


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_name_and_file_of_the_code_that_a_page_mentions_exists(page: Path):
    text = re.sub(r"^ *\| (`hybridlio[^|]*)\|", "", page.read_text(), flags=re.MULTILINE)  # the changes' old names
    names = set(re.findall(r"`(hybridlio(?:\.\w+)+)`", text))
    assert {name for name in names if not is_defined(name)} == set()
    files = set(re.findall(r"`((?:hybridlio|graph|learned|tests|benchmarks|examples|docs)/[\w/.]*)`", text))
    assert {file for file in files if not (ROOT / file).exists()} == set()


def test_the_layout_in_the_readme_is_the_tested_one():
    tested = re.search(
        r"^FLOORS = (\{.*?^\})", (ROOT / "tests/test_architecture.py").read_text(), re.DOTALL | re.MULTILINE
    )
    assert tested
    shown = re.findall(r"^\| (\d) \| `(?:hybridlio/)?(\w+)/` \|", README.read_text(), flags=re.MULTILINE)
    assert {room: int(floor) for floor, room in shown} == ast.literal_eval(tested[1])


def test_the_readme_is_short():
    assert len(README.read_text().split()) <= MAX_README_WORDS


def shown_commands() -> Iterator[tuple[str, list[str]]]:
    for page in PAGES:
        for block in blocks(page, "sh"):
            for line in block.replace("\\\n", " ").splitlines():
                if re.match(r"\s*(hybridlio|torchrun) ", line):
                    words = shlex.split(line, comments=True)
                    yield name_of(page), words[words.index("hybridlio") + 1 :]


def test_every_command_and_option_shown_exists():
    group: Any = typer.main.get_command(app)
    shown = list(shown_commands())
    assert len(shown) >= 30
    for page, (name, *words) in shown:
        known = {option for parameter in group.commands[name].params for option in parameter.opts}
        assert {word for word in words if re.match(r"--?[a-z]", word)} <= known, (page, name)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_script_and_option_of_it_that_a_page_shows_exists(page: Path):
    text = page.read_text().replace("\\\n", " ")
    for script, options in re.findall(r"python ((?:benchmarks|examples|docs)/\w+\.py)([^`\n]*)", text):
        source = with_siblings(ROOT / script)
        words = set(re.findall(r"--[a-z][\w-]*", options.partition("#")[0]))
        assert {option for option in words if f'"{option}"' not in source} == set(), script


def with_siblings(script: Path) -> str:
    """Return the text of a script and of the modules beside it that it imports, which may add its options."""
    text = script.read_text()
    siblings = [script.with_name(f"{name}.py") for name in re.findall(r"^from (\w+) import", text, flags=re.MULTILINE)]
    return text + "".join(path.read_text() for path in siblings if path.is_file())


def test_every_command_is_shown_in_the_readme():
    text = README.read_text()
    assert [name for name in commands() if f"hybridlio {name}" not in text] == []


def commands() -> dict[str, Any]:
    group: Any = typer.main.get_command(app)
    return dict(group.commands)


def test_the_reference_of_the_command_line_holds_every_command_and_option():
    sections = dict(
        re.findall(r"^## (\S+)\n(.*?)(?=^## |\Z)", MADE[DOCS / "reference/cli.md"], flags=re.DOTALL | re.MULTILINE)
    )
    assert list(sections) == list(commands())
    for name, command in commands().items():
        options = {option for p in command.params if p.param_type_name == "option" for option in p.opts}
        assert {option for option in options if f"`{option}`" not in sections[name]} == set(), name


def test_the_api_reference_holds_everything_public():
    text = "".join(page.read_text() for page in (DOCS / "reference").glob("*.md"))
    shown = set(re.findall(r"^::: (\S+)", text, flags=re.MULTILINE))
    public = {f"hybridlio.{name}" for name in hl.__all__} | {"hybridlio.graph.PoseGraph", "hybridlio.graph.Solution"}
    assert public - shown == {"hybridlio.__version__", "hybridlio.HybridLioError"}
    assert "hybridlio.core.errors" in shown  # every error, HybridLioError first
    assert {name for name in shown if not is_defined(name)} == set()


def keys(tree: dict[str, Any]) -> Iterator[str]:
    for key, value in tree.items():
        yield key
        if isinstance(value, dict):
            yield from keys(value)


def test_every_setting_is_explained_and_none_that_does_not_exist():
    text = (DOCS / "how_to/configuration.md").read_text()
    explained = {
        name for row in re.findall(r"^\| (`.+?) \|", text, flags=re.MULTILINE) for name in row[1:-1].split("`, `")
    }
    groups = {"scan_matching", "registration", "local_map", "lstm", "network", "keyframes", "recent_scans"}
    settings = {*keys(hl.Config().model_dump()), *(field.name for field in fields(hl.ImuNoise))}
    assert groups <= settings
    assert explained == settings - groups


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == hl.__version__
    assert citation["license"] == "MIT"
    assert all(reference.get("title") and reference.get("authors") for reference in citation["references"])


def code_of(page: Path) -> str:
    """The Python blocks of a page, each line where it stands on the page, so that tracebacks lead there."""
    text, code = page.read_text(), ""
    for block in re.finditer(r"^```python\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE):
        if not block[1].startswith(NOT_RUN):
            code += "\n" * (text.count("\n", 0, block.start(1)) - code.count("\n")) + block[1]
    return code


@pytest.fixture(scope="module")
def material(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that pages' code finds: a short drive and a run of it."""
    folder = tmp_path_factory.mktemp("material")
    hl.simulate(folder / "drive", hl.SimulationConfig(seconds=2.1, gps=True))
    ok("odometry", folder / "drive", "-o", folder / "run")
    return folder


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=name_of)
def test_the_code_of_a_page_runs(page: Path, material: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(material, tmp_path, dirs_exist_ok=True)
    for block in blocks(page, "yaml"):
        if named := re.match(r"# (\S+\.yaml)", block):
            Path(named[1]).write_text(block)
    exec(compile(code_of(page), str(page), "exec"), {"__name__": "page"})
