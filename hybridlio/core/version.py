"""The version, which nothing heavy has to be imported for."""

__version__ = "0.1.0"
