"""The errors that the library raises. Messages say what is wrong, where (file, row, frame index), and what to do."""


class HybridLioError(Exception):
    """Base class of all errors that the library raises on purpose."""


class DataError(HybridLioError):
    """A recording, file or measurement is missing, malformed or not finite."""


class ConfigError(HybridLioError):
    """A setting is unknown, out of range or contradicts another one."""


class EstimationError(HybridLioError):
    """A pose cannot be estimated from the input (registration, start-up, alignment)."""


class GraphError(HybridLioError):
    """A factor graph is malformed or under-constrained; the message names the keys."""


class MissingDependencyError(HybridLioError):
    """An optional Python package or a system library is missing; the message gives the command that installs it."""
