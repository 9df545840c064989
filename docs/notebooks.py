"""The notebooks of ``examples/notebooks`` as pages and as ``.ipynb`` files.

A notebook is a Python script whose cells begin with ``# %%`` (the percent format of Jupytext, VS Code and Spyder), so
that it runs, is tested and is compared between versions as code. The site shows it and offers it as ``.ipynb``.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

NOTEBOOKS = Path(__file__).resolve().parents[1] / "examples" / "notebooks"
FOLDER = "notebooks"  # of the site
Cell = tuple[bool, str]  # whether it is text, and its content


def notebooks() -> dict[str, list[Cell]]:
    """Return the cells of every notebook by its name."""
    return {path.stem: cells(path.read_text(encoding="utf-8")) for path in sorted(NOTEBOOKS.glob("*.py"))}


def cells(script: str) -> list[Cell]:
    """Return the cells of a script in the percent format."""
    found = []
    for kind, content in re.findall(r"^# %%(.*)\n((?:(?!^# %%).*\n?)*)", script, flags=re.MULTILINE):
        is_text = kind.strip() == "[markdown]"
        content = re.sub(r"^# ?", "", content, flags=re.MULTILINE) if is_text else content
        found.append((is_text, content.strip("\n")))
    return found


def page(name: str, content: list[Cell]) -> str:
    """Return a notebook as a page in Markdown, with a link to its ``.ipynb``."""
    parts = [text if is_text else f"```python\n{text}\n```" for is_text, text in content]
    return "\n\n".join([parts[0], f"[Download the notebook]({name}.ipynb)", *parts[1:]]) + "\n"


def ipynb(content: list[Cell]) -> str:
    """Return a notebook as the content of an ``.ipynb`` file (nbformat 4.5), without output."""

    def cell(number: int, is_text: bool, text: str) -> dict[str, object]:
        own = {"cell_type": "markdown"} if is_text else {"cell_type": "code", "execution_count": None, "outputs": []}
        return {**own, "id": f"cell-{number}", "metadata": {}, "source": text.splitlines(keepends=True)}

    kernel = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    made = [cell(number, *one) for number, one in enumerate(content)]
    return json.dumps({"cells": made, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}, indent=1) + "\n"
