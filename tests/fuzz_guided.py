"""Search for inputs that break a reader, guided by the lines that they reach: Atheris, a libFuzzer for Python.

    python tests/fuzz_guided.py [--seconds 600] [--keep] [READER…]

Each test case replaces one file of a tiny input (see fuzz_readers.py) by bytes; what is kept of tests/corpora, and the
whole files, are where it starts from. A case that gives neither a result nor one clear error is printed and written to
tests/corpora, where fuzz_readers.py repeats it ever after. With ``--keep``, small cases that reach new lines are kept
there too. Exits with 1 if anything broke.
"""

from __future__ import annotations

import argparse
import logging
import subprocess
import sys
import tempfile
import warnings
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests/helpers")]

from fuzz_corpus import CORPORA, MOST_BYTES, MOST_CASES, Corpus  # noqa: E402


def search(name: str, seconds: int, folder: Path) -> None:
    """Run Atheris on one input; it ends the process. Cases that reach new lines go below ``folder``."""
    import atheris

    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    with atheris.instrument_imports(include=["hybridlio"]):
        from fuzz_input import outcome
        from fuzz_inputs import INPUTS

    given = INPUTS[name]
    arguments = given.write(folder / "data")
    corpus = Corpus(name, folder / "data")
    corpus.write_seeds(folder / "seeds")

    def one(case: bytes) -> None:
        with corpus.applied(case):
            text = outcome(given.read, arguments)
        if text not in ("ok", "error"):
            raise RuntimeError(text)

    (folder / "found").mkdir()
    kept = CORPORA / name
    flags = [f"-max_total_time={seconds}", f"-max_len={MOST_BYTES}", f"-artifact_prefix={folder}/", "-verbosity=0"]
    folders = [str(folder / "found"), str(folder / "seeds"), *([str(kept)] if kept.is_dir() else [])]
    atheris.Setup([sys.argv[0], *flags, *folders], one)
    atheris.Fuzz()


def run(name: str, seconds: int, keeps: bool) -> bool:
    """Search in a process of its own, which a crash may end; return whether nothing broke."""
    with tempfile.TemporaryDirectory() as root:
        command = [sys.executable, __file__, "--worker", root, "--seconds", str(seconds), name]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=seconds + 600)
        broken = [path for path in Path(root).glob("*-*") if path.is_file()]
        found = sorted((Path(root) / "found").glob("*"), key=lambda path: path.stat().st_size)
        if done.returncode and not broken:
            raise SystemExit(f"{name}: {done.stderr[-800:]}")
        room = MOST_CASES - len(list((CORPORA / name).glob("*")))
        new = [*broken, *(found[:room] if keeps and room > 0 else [])]
        for path in new:
            (CORPORA / name).mkdir(parents=True, exist_ok=True)
            (CORPORA / name / path.name[-16:]).write_bytes(path.read_bytes())
        print(f"{name}: {len(found)} cases reach new lines, {len(broken)} broke", flush=True)
        if broken:
            lines = [line for line in done.stderr.splitlines() if line.startswith("RuntimeError")]
            print(f"  {(lines or done.stderr.splitlines()[-3:])[0]}", flush=True)
        return not broken


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("readers", nargs="*", metavar="READER", help="(default: all)")
    parser.add_argument("--seconds", type=int, default=600, help="of each (default: %(default)s)")
    parser.add_argument("--keep", action="store_true", help="keep small cases that reach new lines in tests/corpora")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        search(options.readers[0], options.seconds, options.worker)
        return
    if find_spec("atheris") is None:
        raise SystemExit("Atheris is not installed: pip install 'hybridlio[fuzz]'")
    from fuzz_inputs import chosen

    held = [run(name, options.seconds, options.keep) for name in chosen(parser, options.readers)]
    raise SystemExit(0 if all(held) else 1)


if __name__ == "__main__":
    main()
