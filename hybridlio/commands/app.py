"""The command line; each command is a module of ``hybridlio.commands``."""

from __future__ import annotations

from typing import Annotated

import typer

from hybridlio.commands.ablate import ablate
from hybridlio.commands.batch import batch
from hybridlio.commands.calibrate import calibrate
from hybridlio.commands.common import Verbose
from hybridlio.commands.compare import compare
from hybridlio.commands.config import config
from hybridlio.commands.evaluate import evaluate
from hybridlio.commands.export import export
from hybridlio.commands.georeference import georeference
from hybridlio.commands.info import info
from hybridlio.commands.maps.localize import localize
from hybridlio.commands.maps.map import map_
from hybridlio.commands.maps.merge import merge
from hybridlio.commands.odometry import odometry
from hybridlio.commands.optimize import optimize
from hybridlio.commands.report import report
from hybridlio.commands.simulate import simulate
from hybridlio.commands.smooth import smooth
from hybridlio.commands.train import train
from hybridlio.commands.view import view
from hybridlio.core.version import __version__

app = typer.Typer(
    name="hybridlio",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"hybridlio {__version__}")
        raise typer.Exit


@app.callback()
def main(
    _version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    _verbosity: Verbose = 0,
) -> None:
    """Lidar-inertial odometry: estimates a trajectory with covariances, a pose graph and a report from a recording."""


for _command in (
    simulate,
    info,
    calibrate,
    odometry,
    smooth,
    georeference,
    batch,
    compare,
    evaluate,
    report,
    train,
    ablate,
    config,
    view,
    export,
    optimize,
    localize,
    merge,
):
    app.command()(_command)
app.command("map")(map_)
