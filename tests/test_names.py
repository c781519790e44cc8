"""Names that programs give, and the aliases of those that do not fit their fields (PROTOCOL.md 1)."""

import re
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.errors import InvalidName, NameTooLong
from r2p.names import (
    MODULE_FIELD,
    NODE_FIELD,
    TOPIC_FIELD,
    check_aliases,
    chosen_alias,
    module_alias,
    module_name,
    module_name_from,
    module_path,
    node_alias,
    node_name,
    topic_alias,
    topic_name,
)

Check = Callable[[str], str]

KINDS = [(module_name, 64), (node_name, 64), (topic_name, 255)]
ALIASES = [(module_alias, MODULE_FIELD, 3), (node_alias, NODE_FIELD, 4), (topic_alias, TOPIC_FIELD, 12)]

_PART = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,40}", fullmatch=True)
TOPICS = st.lists(_PART, min_size=1, max_size=6).map("/".join)


@pytest.mark.parametrize(("check", "longest"), KINDS)
def test_as_long_as_possible(check: Check, longest: int) -> None:
    assert check("a") == "a"
    assert check("A_9" + "z" * (longest - 3)) == "A_9" + "z" * (longest - 3)
    with pytest.raises(NameTooLong, match=f"has {longest + 1} characters, at most {longest} are possible: shorten it"):
        check("z" * (longest + 1))


@pytest.mark.parametrize(("check", "longest"), KINDS)
@pytest.mark.parametrize("name", ["", " ", "a b", "a-b", "a//b", "é", "²", "a\n", "a\0", "à" * 40])
def test_other_characters_are_refused(check: Check, longest: int, name: str) -> None:
    with pytest.raises(InvalidName, match="use letters, digits and underscores") as caught:
        check(name)
    assert not isinstance(caught.value, NameTooLong)
    assert repr(name) in str(caught.value)


def test_the_error_says_what_it_names() -> None:
    for check, what in [(module_name, "module"), (node_name, "node"), (topic_name, "topic")]:
        with pytest.raises(InvalidName, match=f"^{what} name '!'"):
            check("!")


def test_all_that_is_wrong_is_said_at_once() -> None:
    with pytest.raises(InvalidName) as caught:
        topic_name("front left//2nd-wheel/" + "x" * 300)
    assert str(caught.value) == (
        f"topic name 'front left//2nd-wheel/{'x' * 58}'...: ' ' and '-' can't be in a name; a part of it is empty; "
        "part '2nd-wheel' begins with a digit; it has 322 characters, at most 255 are possible: use letters, digits "
        "and underscores, and `/` between parts, as in robot1/encoder"
    )


def test_one_leading_slash_of_a_topic_is_taken_off() -> None:
    assert topic_name("/leds") == topic_name("leds") == "leds"
    assert topic_name("/a/b/c") == "a/b/c"
    for name in ("//leds", "/", "leds/", "a//b"):
        with pytest.raises(InvalidName, match="empty"):
            topic_name(name)
    for check in (module_name, node_name):
        with pytest.raises(InvalidName):
            check("a/b")


def test_what_was_valid_before_long_names_stays_valid() -> None:
    for name in ("1", "9lives", "robot1/2", "7/8", "x" * 16 + "/" + "9" * 16):
        assert topic_name(name) == name
    for name in ("a/b/1", "1" * 17, "robot1/" + "9" * 17):
        with pytest.raises(InvalidName, match="begins with a digit"):
            topic_name(name)


def test_a_module_of_another_robot() -> None:
    longest = "n" * 16 + "/" + "M" * 64
    for name in ("MOTOR1", "robot1/MOTOR1", "robot1_MOTOR1", longest):
        assert module_path(name) == name
    for name in (longest + "M", "n" * 17 + "/M"):
        with pytest.raises(NameTooLong):
            module_path(name)
    with pytest.raises(InvalidName):
        module_path("a/b/MOTOR1")


@given(st.text(max_size=70))
def test_what_passes_is_a_name(name: str) -> None:
    try:
        checked = node_name(name)
    except InvalidName:
        assert not re.fullmatch(r"[A-Za-z0-9_]{1,64}", name)
    else:
        assert checked == name


@pytest.mark.parametrize(
    ("hostname", "name"),
    [
        ("lab-pc.local", "labpc"),
        ("robot_7", "robot_7"),
        ("a-very-long-host-name", "averylo"),
        ("", "PC"),
        ("---", "PC"),
        (".local", "PC"),
        ("büro", "bro"),
        ("東京", "PC"),
    ],
)
def test_module_name_from_host_name(hostname: str, name: str) -> None:
    assert module_name_from(hostname) == name


@given(st.text())
def test_any_host_gives_a_module_name(hostname: str) -> None:
    assert module_name(module_name_from(hostname)) == module_name_from(hostname)


# Aliases


def test_how_an_alias_is_made() -> None:
    """As docs/PROTOCOL.md 1 has it."""
    assert topic_alias("front_left/wheel/velocity_estimate") == "front_left_w446v"
    assert node_alias("velocity_estimator") == "veloa6tr"
    assert module_alias("robot1/MOTOR1") == "robzofu"
    assert module_alias("r/MOTOR1")[:3] == "r_M"


@pytest.mark.parametrize(("alias", "field", "kept"), ALIASES)
def test_a_name_that_fits_is_its_own_alias(alias: Check, field: int, kept: int) -> None:
    assert alias("x" * field) == "x" * field
    assert re.fullmatch(rf"x{{{kept}}}[0-9a-z]{{4}}", alias("x" * (field + 1)))


@given(TOPICS)
def test_an_alias_is_a_topic_that_every_link_carries(name: str) -> None:
    alias = topic_alias(name)
    assert topic_name(alias) == alias
    assert len(alias) <= TOPIC_FIELD
    assert alias == name or (alias[:12] == name[:12].replace("/", "_") and "/" not in alias)


def test_aliases_that_were_chosen() -> None:
    chosen = check_aliases({"/front_left/wheel/velocity": "flw_vel", "front_left/calibrate": "fl_cal"})
    assert chosen_alias("front_left/wheel/velocity", chosen) == "flw_vel"
    assert chosen_alias("leds", chosen) == "leds"
    assert chosen_alias("front_left/wheel/current", chosen) == topic_alias("front_left/wheel/current")
    assert [chosen_alias(f"front_left/calibrate{each}", chosen) for each in ("_q", "_r")] == ["fl_cal_q", "fl_cal_r"]
    assert chosen_alias("a" * 20 + "_q", {"a" * 20: "b" * 16}) == topic_alias("a" * 20 + "_q")


@pytest.mark.parametrize(
    ("chosen", "text"),
    [
        ({"a" * 20: "x", "b" * 20: "x"}, f"'{'a' * 20}' and '{'b' * 20}' have one alias, 'x': choose another one"),
        ({"a" * 20: "y" * 17}, "has 17 characters, at most 16"),
        ({"a" * 20: "x y"}, "' ' can't be in a name"),
        ({"leds": "l"}, "'leds' needs none, it fits every link: remove the line"),
        ({"a" * 20: "R2P"}, "is the topic of management messages"),
        ({"a b": "x"}, "topic name 'a b'"),
    ],
)
def test_aliases_that_can_not_be_chosen(chosen: dict[str, str], text: str) -> None:
    with pytest.raises(InvalidName) as caught:
        check_aliases(chosen)
    assert text in str(caught.value)
