"""All inputs of the fuzzing, by name."""

from __future__ import annotations

from fuzz_files import FILES
from fuzz_learned import LEARNED
from fuzz_recordings import RECORDINGS

INPUTS = {**RECORDINGS, **FILES, **LEARNED}
