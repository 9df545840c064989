#!/usr/bin/env bash
# Install a copy of the checkout with `pip install .` into an empty environment, run it away from the checkout, and test it.
# Usage: clean_install.sh PYTHON [WORK]     such as: clean_install.sh python3.12
# The environment stays in WORK, or is removed where WORK is not given.
set -euo pipefail

python=$1
checkout=$(cd "$(dirname "$0")/.." && pwd)
if [ $# -gt 1 ]; then
    work=$2
    mkdir -p "$work"
else
    work=$(mktemp -d)
    trap 'rm -rf "$work"' EXIT
fi

git -C "$checkout" archive --prefix=source/ HEAD | tar -x -C "$work"
"$python" -m venv "$work/venv"
pip=("$work/venv/bin/python" -m pip install -q --no-cache-dir --disable-pip-version-check -c "$work/source/constraints.txt")
start=$SECONDS
(cd "$work/source" && "${pip[@]}" .)
echo "$("$work/venv/bin/python" -V): installed in $((SECONDS - start)) s, $(du -sm "$work/venv" | cut -f1) MB"

mkdir -p "$work/away"
cd "$work/away"
hybridlio=$work/venv/bin/hybridlio
"$hybridlio" --version
"$hybridlio" simulate drives --seconds 6 --seed 1
"$hybridlio" odometry drives -o run --overwrite
"$hybridlio" smooth run
"$hybridlio" map run -o map.ply

# The tests see the installed package alone: they run in a copy without the checkout around it.
cp -r "$work/source/tests" .
"${pip[@]}" pytest hypothesis evo
"$work/venv/bin/python" -m pytest -q -p no:dash -p no:cacheprovider --import-mode=importlib -o pythonpath=tests/helpers \
    tests/hybridlio/core tests/hybridlio/registration tests/hybridlio/sources tests/graph/base tests/graph/solve tests/learned/losses
