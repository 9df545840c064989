"""Run the command line by ``python -m hybridlio``."""

from hybridlio.commands.app import app

app()
