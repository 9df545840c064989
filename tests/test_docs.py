"""The documentation says what is so: links lead somewhere, commands and settings exist, the README's Python runs."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import typer

import hybridlio as hl
from hybridlio.commands.app import app
from hybridlio.graph import PoseGraph

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(), flags=re.DOTALL)


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, by the usual rule: lower case, no punctuation, hyphens for spaces."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_somewhere(page):
    dead = []
    for link in re.findall(r"\]\(([^)]+)\)", page.read_text()):
        if link.startswith("https://"):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            dead.append(link)
    assert dead == []


def shown_commands() -> Iterator[list[str]]:
    for page in PAGES:
        for block in blocks(page, "sh"):
            yield from (
                shlex.split(line, comments=True) for line in block.splitlines() if line.startswith("hybridlio ")
            )


def test_every_command_and_option_shown_exists():
    group = typer.main.get_command(app)
    shown = list(shown_commands())
    assert len(shown) >= 5
    for _, name, *words in shown:
        known = {option for parameter in group.commands[name].params for option in parameter.opts}
        assert {word for word in words if re.match(r"--?[a-z]", word)} <= known, name


def test_every_command_is_shown_in_the_readme():
    text = (ROOT / "README.md").read_text()
    assert [name for name in typer.main.get_command(app).commands if f"hybridlio {name}" not in text] == []


def keys(tree: dict) -> Iterator[str]:
    for key, value in tree.items():
        yield key
        if isinstance(value, dict):
            yield from keys(value)


def test_every_setting_is_explained_and_none_that_does_not_exist():
    text = (ROOT / "docs/configuration.md").read_text()
    explained = {
        name for row in re.findall(r"^\| (`.+?) \|", text, flags=re.MULTILINE) for name in row[1:-1].split("`, `")
    }
    groups = {"scan_matching", "registration", "local_map", "lstm", "network", "keyframes", "recent_scans"}
    settings = {*keys(hl.Config().model_dump()), *(field.name for field in fields(hl.ImuNoise))}
    assert groups <= settings
    assert explained == settings - groups


def test_the_readmes_python_runs(tmp_path, monkeypatch):
    odometry, pose_graph = blocks(ROOT / "README.md", "python")
    drive = hl.simulate(tmp_path, hl.SimulationConfig(seconds=1.0, lidar="16-beam"))
    shown: dict[str, object] = {}
    exec(re.sub(r'open_sequence\(".*?"\)', f"open_sequence({str(drive)!r})", odometry), shown)
    assert shown["evaluation"].ate_m < 0.1
    graph = PoseGraph()
    graph.add_prior(0, np.eye(4), sigmas=(1e-3,) * 6)
    graph.add_between(0, 1, np.eye(4), sigmas=(0.1,) * 6)
    graph.save(tmp_path / "map.g2o", graph.optimize())
    monkeypatch.chdir(tmp_path)
    exec(pose_graph, shown)
    assert shown["solution"].error < 1e-9
