"""All inputs of the fuzzing, by name."""

from __future__ import annotations

import argparse

from fuzz_files import FILES
from fuzz_learned import LEARNED
from fuzz_recordings import RECORDINGS

INPUTS = {**RECORDINGS, **FILES, **LEARNED}


def chosen(parser: argparse.ArgumentParser, names: list[str]) -> list[str]:
    """Return the names that are given, or all; end the program where one is unknown."""
    if unknown := [name for name in names if name not in INPUTS]:
        parser.error(f"no reader is named {', '.join(map(repr, unknown))}; there are {', '.join(INPUTS)}")
    return names or list(INPUTS)
