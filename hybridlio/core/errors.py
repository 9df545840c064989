"""The one family of errors: each says what was wrong, where, and what to do."""


class HybridLioError(Exception):
    """Base of every error the library raises on purpose; catch it to catch them all."""


class DataError(HybridLioError):
    """A recording, file or measurement is missing, malformed or not finite."""


class ConfigError(HybridLioError):
    """A setting is unknown, out of range or contradicts another."""


class EstimationError(HybridLioError):
    """A pose could not be estimated from the input (registration, start-up, alignment)."""


class GraphError(HybridLioError):
    """A factor graph is malformed or under-constrained; names the keys concerned."""


class MissingDependencyError(HybridLioError):
    """An optional or system library is absent; names the command that installs it."""
