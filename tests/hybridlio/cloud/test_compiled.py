import os
import subprocess
import sys

from hybridlio.cloud.compiled import compiled


def total(values: tuple[int, ...]) -> int:
    out = 0
    for value in values:
        out += value
    return out


def test_a_compiled_function_gives_what_the_plain_one_gives():
    assert compiled(total)((1, 2, 3)) == total((1, 2, 3))


def test_a_function_without_a_file_to_keep_its_code_beside_is_compiled_too():
    made: dict[str, object] = {}
    exec("def double(x):\n    return 2 * x\n", made)  # as from an archive, or where no folder can be written
    assert compiled(made["double"])(21) == 42


def test_compiling_is_announced_once_and_loading_what_was_compiled_is_not(tmp_path):
    (tmp_path / "loops.py").write_text(
        "from hybridlio.cloud.compiled import compiled\n"
        "@compiled\n"
        "def double(x):\n"
        "    return 2 * x\n"
        "@compiled\n"
        "def triple(x):\n"
        "    return 3 * x\n"
    )
    call = [sys.executable, "-c", "import loops; print(loops.double(1), loops.triple(1))"]
    folders = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    first, second = (
        subprocess.run(call, env=os.environ | {"PYTHONPATH": folders}, capture_output=True, text=True) for _ in range(2)
    )
    assert first.stdout == second.stdout == "2 3\n", first.stderr
    assert first.stderr.count("compiling loops") == 1
    assert second.stderr == ""
