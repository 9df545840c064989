"""The shell completes names of sources, scenes, formats and the like."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from hybridlio.commands.app import app
from hybridlio.odometry.names import INITIAL_POSES

WITHOUT_NAMES = {"--sequence"}  # names of recordings; those of topics and frames stand in the data, too
GROUP: Any = typer.main.get_command(app)


def environment(*words: str) -> dict[str, str]:
    """What bash sets when the last of these words is to be completed."""
    return {
        "_HYBRIDLIO_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join(("hybridlio", *words)),
        "COMP_CWORD": str(len(words)),
    }


def completed(*words: str) -> list[str]:
    result = CliRunner().invoke(app, [], prog_name="hybridlio", env=environment(*words))
    return result.stdout.split()


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (("odometry", "DATA", "--initial-pose", ""), list(INITIAL_POSES)),
        (("odometry", "DATA", "--residual", "n"), ["network", "network+scan-matching", "none"]),
        (("odometry", "DATA", "--backend", "f"), ["fixed-lag"]),
        (("compare", "DATA", "--initial-pose", "lstm,ka"), ["lstm,kalman"]),
        (("info", "DATA", "--reader", "kitti-"), ["kitti-360", "kitti-odometry", "kitti-raw"]),
        (("map", "RUN", "--color", ""), ["height", "intensity", "none", "time"]),
        (("map", "RUN", "--tiles", "la"), ["las", "laz"]),
        (("smooth", "RUN", "--robust", "g"), ["gnc", "geman-mcclure"]),
        (("simulate", "OUT", "--scene", "t"), ["town", "tunnel"]),
        (("simulate", "OUT", "--lidar", "os"), ["os0", "os1"]),
        (("optimize", "IN", "--solver", "ba"), ["batch"]),
        (("train", "DATA", "--preset", "pu"), ["published"]),
        (("ma",), ["map"]),
    ],
)
def test_names_are_completed(words: tuple[str, ...], names: list[str]) -> None:
    assert sorted(completed(*words)) == sorted(names)


def test_every_option_that_takes_a_name_is_completed() -> None:
    for command in GROUP.commands.values():
        for parameter in command.params:
            is_topic = parameter.rich_help_panel == "Bags" if hasattr(parameter, "rich_help_panel") else False
            if parameter.metavar in ("NAME", "A,B,…") and not is_topic and not WITHOUT_NAMES & set(parameter.opts):
                assert completed(command.name, parameter.opts[0], ""), (command.name, parameter.opts)


def test_a_shell_gets_the_names_without_loading_a_heavy_library() -> None:
    variables = {**os.environ, **environment("odometry", "DATA", "--initial-pose", "k")}
    code = """import sys, atexit
atexit.register(lambda: print(sorted({"gtsam", "torch", "open3d"} & set(sys.modules)), file=sys.stderr))
from hybridlio.commands.app import app
app(prog_name="hybridlio")
"""
    root = Path(__file__).parents[3]
    done = subprocess.run(
        [sys.executable, "-c", code], env=variables, cwd=root, capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == ["kalman"]
    assert done.stderr.split() == ["[]"]
