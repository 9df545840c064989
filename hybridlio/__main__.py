"""``python -m hybridlio``: the command line."""

from hybridlio.cli import app

app()
