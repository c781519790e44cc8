"""Lines of the log that others can make happen."""

from r2p.log_lines import LineLimit


def test_the_lines_of_a_kind_are_limited_and_the_next_one_says_how_many_were_left_out() -> None:
    limit = LineLimit(2, period=60)
    assert [limit.suffix("a", now) for now in (0, 1, 2, 59)] == ["", "", None, None]
    assert limit.suffix("b", 59) == ""
    assert limit.suffix("a", 60) == " (2 more since the last such line)"
    assert limit.suffix("a", 120) == ""
