"""Names as they fit the wire (PROTOCOL.md 1)."""

import re
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from r2p.errors import InvalidName, NameTooLong
from r2p.names import MODULE_MAX, NODE_MAX, TOPIC_MAX, module_name, module_name_from, node_name, topic_name

Check = Callable[[str], str]

KINDS = [(module_name, 7), (node_name, 8), (topic_name, 16)]


def test_lengths_are_those_of_the_wire() -> None:
    assert (MODULE_MAX, NODE_MAX, TOPIC_MAX) == (7, 8, 16)


@pytest.mark.parametrize(("check", "longest"), KINDS)
def test_as_long_as_the_field(check: Check, longest: int) -> None:
    assert check("a") == "a"
    assert check("A_9" + "z" * (longest - 3)) == "A_9" + "z" * (longest - 3)
    with pytest.raises(NameTooLong, match=f"has {longest + 1} characters, the wire carries {longest}: shorten it"):
        check("z" * (longest + 1))


@pytest.mark.parametrize(("check", "longest"), KINDS)
@pytest.mark.parametrize("name", ["", " ", "a b", "a-b", "a/b/c", "é", "²", "a\n", "a\0", "à" * 40])
def test_other_characters_are_refused(check: Check, longest: int, name: str) -> None:
    with pytest.raises(InvalidName, match="use letters, digits and underscores") as caught:
        check(name)
    assert not isinstance(caught.value, NameTooLong)
    assert repr(name) in str(caught.value)


def test_the_error_says_what_it_names() -> None:
    for check, what in [(module_name, "module"), (node_name, "node"), (topic_name, "topic")]:
        with pytest.raises(InvalidName, match=f"^{what} name '!'"):
            check("!")


def test_one_leading_slash_of_a_topic_is_taken_off() -> None:
    assert topic_name("/leds") == topic_name("leds") == "leds"
    assert topic_name("/" + "x" * 16) == "x" * 16
    for name in ("//leds", "/", "leds/", "/a/b/c", "a/b/c", "a b/c", ""):
        with pytest.raises(InvalidName, match="and at most one `/`, after a namespace, as in robot1/encoder") as caught:
            topic_name(name)
        assert f"topic name {name!r}: " in str(caught.value)
    with pytest.raises(InvalidName):
        module_name("/PC1")


def test_a_topic_may_be_in_a_namespace() -> None:
    assert topic_name("/robot1/leds") == topic_name("robot1/leds") == "robot1/leds"
    assert topic_name(f"{'x' * 16}/{'y' * 16}") == f"{'x' * 16}/{'y' * 16}"
    for name in (f"{'x' * 17}/y", f"x/{'y' * 17}"):
        with pytest.raises(NameTooLong):
            topic_name(name)
    with pytest.raises(InvalidName):
        node_name("a/b")


@given(st.text(max_size=20))
def test_what_passes_is_on_the_wire_as_it_is(name: str) -> None:
    try:
        checked = node_name(name)
    except InvalidName:
        assert not re.fullmatch(r"[A-Za-z0-9_]{1,8}", name)
    else:
        assert checked == name
        assert len(name.encode()) <= NODE_MAX


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
