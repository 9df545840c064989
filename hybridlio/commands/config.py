"""``hybridlio config``."""

from __future__ import annotations

from hybridlio.commands.common import Verbose, guarded
from hybridlio.commands.terminal import print_result


@guarded
def config(_verbosity: Verbose = 0) -> None:
    """Print all settings with their defaults as YAML.

    Save them by `hybridlio config > my.yaml`, edit the file, and use it with --config my.yaml.
    """
    from hybridlio.odometry.config import Config, config_to_yaml

    print_result(config_to_yaml(Config()).rstrip())
