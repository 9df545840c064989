"""An extension of mkdocstrings that adapts docstrings to what the site's parser reads.

Sphinx roles become plain code: ``:class:`Odometry` `` is shown as ``Odometry``. An item that describes several names at
once, such as ``sigmas, covariance: one of them``, becomes one item for each name.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

ROLE = re.compile(r":(?:class|func|meth|data|mod|attr|exc):`~?\.?([^`]+)`")
SEVERAL = re.compile(r"^(?P<indent> +)(?P<names>\w+(?:, \w+)+): (?P<text>.+(?:\n(?P=indent) +\S.*)*)", re.MULTILINE)


class AdaptDocstrings(griffe.Extension):
    """Adapt the docstring of every object."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Change the docstring of one module, class, function or attribute."""
        if obj.docstring:
            obj.docstring.value = SEVERAL.sub(one_item_each, ROLE.sub(r"`\1`", obj.docstring.value))


def one_item_each(item: re.Match[str]) -> str:
    """Return the item once for each of its names."""
    return "\n".join(f"{item['indent']}{name}: {item['text']}" for name in item["names"].split(", "))
