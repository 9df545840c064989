"""The pages of the site that are made while it is built: the command line, notebooks, and files of other folders.

A hook of MkDocs (``hooks`` in mkdocs.yml). Nothing is written to the docs folder.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path, PurePosixPath
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))  # the commands of this checkout, installed or not

from docs import notebooks  # noqa: E402  (needs the path above)
from docs.make_cli_reference import cli_reference  # noqa: E402

FROM_ELSEWHERE = {  # page of the site: the file that it shows
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
    "benchmarks.md": "benchmarks/README.md",
}
PAGE_OF = {file: page for page, file in FROM_ELSEWHERE.items()}
LAYOUT = "layout.md"  # shows the section "Layout" of the README


def on_files(files: Any, config: Any) -> Any:
    """Add the made pages to those that lie in the docs folder."""
    from mkdocs.structure.files import File

    for page, text in made_pages().items():
        files.append(File.generated(config, page, content=text))
    for name, content in notebooks.notebooks().items():
        file = f"{notebooks.FOLDER}/{name}.ipynb"
        files.append(File.generated(config, file, content=notebooks.ipynb(content)))
    return files


def made_pages() -> dict[str, str]:
    """Return the made pages by name, as Markdown."""
    pages = {"reference/cli.md": cli_reference()}
    for page, file in FROM_ELSEWHERE.items():
        pages[page] = with_links_of_the_site((ROOT / file).read_text(encoding="utf-8"), file)
    for name, content in notebooks.notebooks().items():
        pages[f"{notebooks.FOLDER}/{name}.md"] = notebooks.page(name, content)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    layout = re.search(r"^## Layout\n(.*?)(?=^## )", readme, flags=re.DOTALL | re.MULTILINE)
    pages[LAYOUT] = f"# Layout\n{with_links_of_the_site(layout[1], 'README.md')}" if layout else ""
    return pages


def with_links_of_the_site(text: str, file: str) -> str:
    """Return a page of the repository with its relative links as they lead from the root of the site.

    Links to the docs folder lead to its pages, links to other files of the repository that the site shows to those
    pages. A link to a file that the site does not show stays as its text.
    """

    def moved(link: re.Match[str]) -> str:
        words, target = link[1], link[2]
        path, hash_, anchor = target.partition("#")
        if target.startswith(("https://", "#")):
            return link[0]
        inside = os.path.normpath(PurePosixPath(file).parent / path)
        if (inside, anchor) == ("README.md", "layout"):
            return f"[{words}]({LAYOUT})"
        page = inside.removeprefix("docs/") if inside.startswith("docs/") else PAGE_OF.get(inside)
        return f"[{words}]({page}{hash_}{anchor})" if page else words

    return re.sub(r"\[([^]]+)\]\(([^)\s]+)\)", moved, text)
