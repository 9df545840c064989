"""List the licences of all that hybridlio imports, and fail if one is GPL or unknown."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib import metadata

from packaging.requirements import Requirement

# LGPL leaves what imports it free; packages of the system that runs CUDA are no part of the imports.
_REFUSED, _FREE = ("GPL", "GNU GENERAL", "UNKNOWN"), ("LGPL", "LESSER")


def imported(root: str) -> set[str]:
    """Return the names of the distributions that one needs, without its extras, those it needs in turn included."""
    found: set[str] = set()
    waiting = [root]
    while waiting:
        name = waiting.pop().lower().replace("_", "-")
        if name in found:
            continue
        try:
            needed = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue  # for another system
        found.add(name)
        requirements = map(Requirement, needed)
        waiting += [r.name for r in requirements if r.marker is None or r.marker.evaluate({"extra": ""})]
    return found


def main() -> int:
    """Print a table and return the exit code."""
    command = [sys.executable, "-m", "piplicenses", "--format=json", "--from=mixed", "--with-system"]
    rows = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    licences = {row["Name"].lower().replace("_", "-"): row["License"] for row in rows}
    refused = 0
    for name in sorted(imported("hybridlio") - {"hybridlio"}):
        licence = licences.get(name, "UNKNOWN").splitlines()[0][:60]
        upper = licence.upper()
        is_refused = any(word in upper for word in _REFUSED) and not any(word in upper for word in _FREE)
        refused += is_refused
        print(f"{'REFUSED ' if is_refused else ''}{name}: {licence}")
    return 1 if refused else 0


if __name__ == "__main__":
    raise SystemExit(main())
