"""The package's front door: names that load when first used."""

from __future__ import annotations

import ast
import importlib
import inspect
from pathlib import Path

import pytest

import hybridlio


def names_seen_by_type_checkers() -> dict[str, str]:
    tree = ast.parse(Path(inspect.getfile(hybridlio)).read_text())
    guarded = next(node for node in tree.body if isinstance(node, ast.If))
    imports = [node for node in guarded.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: str(node.module) for node in imports for alias in node.names}


def test_type_checkers_see_every_lazily_loaded_name_in_its_module():
    assert names_seen_by_type_checkers() == hybridlio._HOME_OF
    assert set(hybridlio.__all__) == {*hybridlio._HOME_OF, "__version__"}


def test_the_docstring_names_everything_public():
    assert [name for name in hybridlio.__all__ if name != "__version__" and name not in (hybridlio.__doc__ or "")] == []


@pytest.mark.parametrize("name", sorted(hybridlio.__all__))
def test_every_public_name_is_that_of_its_module(name):
    home = importlib.import_module(hybridlio._HOME_OF.get(name, "hybridlio"))
    assert getattr(hybridlio, name) is getattr(home, name)
    assert name in dir(hybridlio)


def test_an_unknown_name_raises_an_attribute_error_that_names_it():
    with pytest.raises(AttributeError, match="open_squence"):
        _ = hybridlio.open_squence


def test_a_configuration_file_is_read_by_its_path_as_text(tmp_path: Path):
    path = tmp_path / "my.yaml"
    path.write_text("residual: none\n")
    assert hybridlio.load_config(str(path)) == hybridlio.Config(residual="none")
