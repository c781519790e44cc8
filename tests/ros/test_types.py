"""Definitions of ROS types, and the md5 sums and hashes of real ROS."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import r2p
from r2p.ros.cdr import cdr
from r2p.ros.classes import TIMES, RosTypes, definitions_of
from r2p.ros.definitions import (
    SEPARATOR,
    TEXT_MAX,
    definition_text,
    md5,
    parse,
    parse_action,
    parse_service,
    plain_text,
    service_md5,
)
from r2p.ros.hashes import TypeDescriptions
from r2p.ros.type_names import short_name
from r2p.tools.types import standard_types
from tests.ros.recorded import definitions, recorded

CLASSES = [cls for cls in standard_types() if cls not in TIMES.values()]


@pytest.mark.parametrize("case", recorded(1)["type_md5s"], ids=lambda case: str(case["type"]))
def test_md5_sums_and_texts_of_ros1(case: dict[str, Any]) -> None:
    found = parse(case["type"], case["definition"])
    assert md5(case["type"], found) == case["md5"]
    assert definition_text(case["type"], found) == case["definition"]
    without_comments = {name: parse(name, plain_text(each))[name] for name, each in found.items()}
    assert md5(case["type"], without_comments) == case["md5"]


@pytest.mark.parametrize("case", recorded(1)["services"], ids=lambda case: str(case["type"]))
def test_md5_sums_of_services(case: dict[str, Any]) -> None:
    request, response = case["request_type"], case["response_type"]
    found = parse(request, case["request_definition"]) | parse(response, case["response_definition"])
    assert (md5(request, found), md5(response, found)) == (case["request_md5"], case["response_md5"])
    assert service_md5(request, response, found) == case["md5"]


def _missing(types: TypeDescriptions, name: str) -> bool:
    """Whether the recording lacks the definition of a type in this one."""
    try:
        types.hash(name)
    except r2p.MessageError as error:
        assert "is missing" in str(error)  # noqa: PT017 - raised or not
        return True
    return False


def test_hashes_of_ros2() -> None:
    types = TypeDescriptions(definitions(2))
    hashes = [case for case in recorded(2)["message_hashes"] if not _missing(types, case["type"])]
    assert len(hashes) > 90
    assert [case["type"] for case in hashes if types.hash(case["type"]) != case["hash"]] == []


def test_hashes_of_services() -> None:
    types = TypeDescriptions(definitions(2))
    parts = {"": "hash", "_Request": "request_hash", "_Response": "response_hash", "_Event": "event_hash"}
    compared = 0
    for case in recorded(2)["service_hashes"]:
        request, response = parse_service(case["type"], case["definition"])
        types.add_service(case["type"], request.fields, response.fields)
        if not _missing(types, case["type"]):
            compared += 1
            assert {part: types.hash(case["type"] + part) for part in parts} == {
                part: case[key] for part, key in parts.items()
            }
    assert compared > 14


def test_hashes_of_actions() -> None:
    types = TypeDescriptions(definitions(2))
    for case in recorded(2)["action_hashes"]:
        types.add_action(case["type"], *[part.fields for part in parse_action(case["type"], case["definition"])])
        assert types.hash(case["type"]) == case["hash"]
        assert {part: types.hash(f"{case['type']}_{part}") for part in case["parts"]} == case["parts"]


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: str(cls.__name__))
def test_a_class_becomes_a_definition_and_that_the_same_class(cls: type[r2p.Message], version: int) -> None:
    found = definitions_of(cls, version)
    name = next(iter(found))
    made = RosTypes(version, found, known={}).load(name)
    fields = [field.wire_name for field in r2p.layout(made).fields]
    assert fields == [field.wire_name for field in r2p.layout(cls).fields]
    assert definitions_of(made, version)[name].text == found[name].text
    assert RosTypes(version, found).load(name) is cls or "char[" in r2p.layout(cls).schema


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("float32", "not a field"),
        ("float32 2nd", "not a field"),
        ("float33x! a", "is not a type"),
        ("int32<=5 a", "only texts have a bound"),
        ("geometry_msgs/Point P=1", "a constant is"),
        ("int32 a\nint32 a", "two fields a"),
        ("#" * (TEXT_MAX + 1), "has 1048577 characters, more than 1048576"),
        ("int32 a\n" + "=" * 80 + "\nnothing", "title of a nested type"),
    ],
)
def test_texts_that_are_no_definitions(text: str, error: str) -> None:
    with pytest.raises(r2p.MessageError, match=error) as raised:
        parse("my_msgs/Thing", text)
    assert "my_msgs/Thing" in str(raised.value)


@pytest.mark.parametrize(
    ("line", "value"),
    [
        ("string S=  a # b  ", "a # b"),
        ("int32 S=5 # five", "5"),
        ('string s "a # b" # c', '"a # b"'),
        ("bool s true", "true"),
    ],
)
def test_constants_and_defaults(line: str, value: str) -> None:
    found = parse("my_msgs/Thing", line)["my_msgs/Thing"]
    assert [each.value for each in found.constants] + [each.default for each in found.fields] == [value]


def test_types_that_contain_themselves_or_what_is_missing() -> None:
    found = parse("a_msgs/A", "B b\n" + "=" * 80 + "\nMSG: a_msgs/B\nA a\n")
    for use in (lambda: md5("a_msgs/A", found), lambda: RosTypes(1, found).load("a_msgs/A")):
        with pytest.raises(r2p.MessageError, match="contains itself"):
            use()
    with pytest.raises(r2p.MessageError, match="contains itself"):
        TypeDescriptions(found).hash("a_msgs/A")
    with pytest.raises(r2p.MessageError, match="a_msgs/B is missing, which is in a_msgs/A"):
        RosTypes(1, parse("a_msgs/A", "B b")).load("a_msgs/A")


def tower(levels: int, line: str) -> str:
    """Each type holds the next one as `line` says, with `{}` for its name."""
    texts = [line.format(f"T{level + 1}") + f"\n{SEPARATOR}\nMSG: a_msgs/T{level + 1}\n" for level in range(levels)]
    return "".join(texts) + "int8 x\n"


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (tower(400, "{} x"), "a_msgs/T0 has more than 32 types in one another, down to a_msgs/T33"),
        (tower(30, "{0} x\n{0} y"), "a_msgs/T17 has 8192 fields with all types in it, more than 4096"),
        (tower(3, "{}[999] x"), "a_msgs/T0 has 997002999 values"),
        ("float64[999999999] x", "a_msgs/T0 has 999999999 values"),
        ("uint8 class\nuint8 class_", "a_msgs/T0: a class can't have both fields class and class_"),
    ],
)
def test_definitions_that_blow_up_are_refused(text: str, error: str) -> None:
    found = parse("a_msgs/T0", text)
    assert len(md5("a_msgs/T0", found)) == 32  # of as many types as there are, not of as many fields
    with pytest.raises(r2p.MessageError, match=error):
        RosTypes(1, found).load("a_msgs/T0")


@pytest.mark.parametrize("name", ["", "Imu", "a/b/c", "a/msg/", "sensor_msgs/Imu/", "1a/B", "a/msg/srv/B"])
def test_names_that_are_not_of_types(name: str) -> None:
    with pytest.raises(r2p.MessageError, match="not the name of a ROS type"):
        short_name(name)


@given(st.text(st.sampled_from("int32 string<=[5]#\n\t/=aA\"'" + "=" * 3), max_size=60))
def test_any_text_is_a_definition_or_an_error(text: str) -> None:
    try:
        found = parse("my_msgs/Thing", text)
        RosTypes(2, found).load("my_msgs/Thing")
        definition_text("my_msgs/Thing", found)
    except r2p.MessageError:
        pass


def test_a_type_with_very_many_values_takes_no_seconds_to_compile() -> None:
    """A definition of a page means 65 536 values, and Python compiles each name in the code of a class."""
    cls = RosTypes(2, parse("a_msgs/Wide", "".join(f"float32[256] a{n}\n" for n in range(256)))).load("a_msgs/Wide")
    message = cls(a0=tuple(map(float, range(256))), a200=(1.5,) * 256)
    codec = cdr(cls)
    assert codec.encode(message)[4:] == message.encode()
    assert codec.decode(codec.encode(message)) == cls.decode(message.encode()) == message
    assert codec.decode.__code__.co_nlocals < 8000
    assert r2p.layout(cls).decode.__code__.co_nlocals < 8000
    with pytest.raises(r2p.MessageError, match=r"Wide\.a200"):
        codec.encode(cls(a200=(1.0,)))
