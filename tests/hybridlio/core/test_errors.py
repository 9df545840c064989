from hybridlio.core.errors import DataError


def test_a_message_that_a_file_makes_long_keeps_its_begin_and_its_end():
    assert str(DataError("a.ply: short")) == "a.ply: short"
    message = str(DataError(f"a.ply: expected fields x y z, found {'x' * 100_000}; write them"))
    assert message.startswith("a.ply: expected fields x y z, found xxx")
    assert message.endswith("xxx; write them")
    assert len(message) < 2100
