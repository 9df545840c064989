"""``python -m hybridlio``: the command line."""

from hybridlio.commands.app import app

app()
