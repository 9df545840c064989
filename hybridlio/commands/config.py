"""``hybridlio config``."""

from __future__ import annotations

from hybridlio.commands.common import Verbose, guarded
from hybridlio.commands.terminal import say


@guarded
def config(_verbose: Verbose = 0) -> None:
    """Print all settings with their defaults as YAML: ``hybridlio config > my.yaml``, change, ``--config my.yaml``."""
    from hybridlio.odometry.config import Config, config_to_yaml

    say(config_to_yaml(Config()).rstrip())
