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
