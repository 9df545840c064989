"""The package works from a plain checkout, and as a wheel without the checkout."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import hybridlio

PACKAGES = ("hybridlio", "graph", "learned")
LINKS = ("hybridlio/graph", "hybridlio/learned")


def run_python(*args: str, cwd: Path, path: Path | None = None) -> str:
    env = {**os.environ, "PYTHONPATH": str(path or "")}
    done = subprocess.run([sys.executable, *args], cwd=cwd, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def copy_sources(root: Path, target: Path) -> Path:
    target.mkdir()
    for package in PACKAGES:
        shutil.copytree(root / package, target / package, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(root / name, target)
    return target


def build_wheel(sources: Path, target: Path) -> Path:
    options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", str(target)]
    run_python("-m", "pip", "wheel", *options, str(sources), cwd=target.parent)
    (wheel,) = target.glob("hybridlio-*.whl")
    return wheel


@pytest.fixture(scope="module")
def wheel(project_root, tmp_path_factory) -> Path:
    """The wheel, built from a copy of the sources so that files of an earlier build cannot get into it."""
    work = tmp_path_factory.mktemp("wheel")
    return build_wheel(copy_sources(project_root, work / "sources"), work / "out")


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    """A folder with the unpacked wheel alone, for PYTHONPATH."""
    target = tmp_path_factory.mktemp("installed")
    options = ["--quiet", "--no-deps", "--no-index", "--target", str(target)]
    run_python("-m", "pip", "install", *options, str(wheel), cwd=target)
    return target


def shipped_files(root: Path) -> set[str]:
    """Return the names of all files that the wheel must hold: code, type marker, templates, tables and weights."""
    found = set()
    for package in PACKAGES:
        for path in (root / package).rglob("*"):
            inside = path.relative_to(root).as_posix()
            if path.suffix in {".py", ".typed", ".jinja", ".safetensors", ".csv"} and not inside.startswith(LINKS):
                found.add(inside if package == "hybridlio" else f"hybridlio/{inside}")
    return found


def test_the_wheel_holds_every_module_template_and_weight_once(project_root, wheel):
    names = zipfile.ZipFile(wheel).namelist()
    content = [name for name in names if ".dist-info/" not in name]
    assert sorted(content) == sorted(shipped_files(project_root))
    assert {"hybridlio/py.typed", "hybridlio/graph/__init__.py", "hybridlio/learned/__init__.py"} <= set(content)


def test_the_wheel_does_not_depend_on_the_links_inside_the_checkout(project_root, wheel, tmp_path):
    sources = copy_sources(project_root, tmp_path / "sources")
    for link in LINKS:
        (sources / link).unlink()
    unlinked = build_wheel(sources, tmp_path / "out")
    assert sorted(zipfile.ZipFile(unlinked).namelist()) == sorted(zipfile.ZipFile(wheel).namelist())


def test_the_installed_wheel_is_complete_outside_the_checkout(installed, tmp_path):
    modules = "hybridlio, hybridlio.graph, hybridlio.learned, hybridlio.datasets, hybridlio.simulation"
    code = f"import {modules}; print(*[m.__file__ for m in ({modules})], sep='\\n')"
    files = run_python("-c", code, cwd=tmp_path, path=installed).splitlines()
    assert len(files) == 5
    assert all(Path(file).is_relative_to(installed) for file in files)


def test_the_installed_command_line_prints_its_version_outside_the_checkout(installed, tmp_path):
    assert hybridlio.__version__ in run_python("-m", "hybridlio", "--version", cwd=tmp_path, path=installed)
    script = installed / "bin/hybridlio"
    assert hybridlio.__version__ in run_python(str(script), "--version", cwd=tmp_path, path=installed)


def test_a_plain_checkout_works_without_installing(project_root, tmp_path):
    checkout = copy_sources(project_root, tmp_path / "checkout")
    code = "import hybridlio.graph, hybridlio.learned; print(hybridlio.graph.__file__, hybridlio.learned.__file__)"
    files = run_python("-c", code, cwd=checkout).split()
    assert all(Path(file).is_relative_to(checkout / "hybridlio") for file in files)
    assert hybridlio.__version__ in run_python("-m", "hybridlio", "--version", cwd=checkout)


def test_the_image_has_the_system_libraries_that_the_checkout_installs_and_leaves_no_source_out(project_root):
    script = (project_root / "scripts/system-libraries.sh").read_text()
    packages = script.partition("packages=(")[2].partition(")")[0].split()
    image = (project_root / "Dockerfile").read_text()
    assert [package for package in packages if package not in image.split()] == []
    ignored = [line for line in (project_root / ".dockerignore").read_text().splitlines() if line and line[0] != "#"]
    kept = git_files(project_root)
    for pattern in ignored:  # rooted unless it begins with **
        name = pattern.removeprefix("**/").rstrip("/")
        inside = [f for f in kept if Path(f).match(name) or f.startswith(f"{name}/")]
        assert inside == [], pattern


def git_files(root: Path) -> list[str]:
    """Return the files of the checkout that git keeps; all of them below the packages where there is no git."""
    done = subprocess.run(["git", "ls-files"], cwd=root, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return done.stdout.split("\n")
    return [p.relative_to(root).as_posix() for name in PACKAGES for p in (root / name).rglob("*.py")]
