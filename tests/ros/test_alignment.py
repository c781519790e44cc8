"""CDR of types of any shape, against another implementation: what lies between fields depends on all before them."""

from typing import Annotated, Any

import numpy
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import r2p
from r2p.ros.cdr import HEADER, cdr, packed_size
from r2p.ros.classes import RosTypes
from r2p.ros.definitions import SEPARATOR, FieldDefinition, parse

VALUES: dict[str, st.SearchStrategy[Any]] = {
    "bool": st.booleans(),
    "int8": st.integers(-128, 127),
    "uint16": st.integers(0, 2**16 - 1),
    "int32": st.integers(-(2**31), 2**31 - 1),
    "uint64": st.integers(0, 2**64 - 1),
    "float32": st.floats(allow_nan=False, width=32),
    "float64": st.floats(allow_nan=False),
    "string": st.text("aé\0", max_size=9),
}
SUFFIXES = ["", "", "[]", "[3]", "[<=2]"]

Pair = tuple[Any, Any]
"""A value as r2p has it, and as rosbags has it."""


def fields(*kinds: str) -> st.SearchStrategy[str]:
    """The text of a definition with such fields."""
    each = st.tuples(st.sampled_from(kinds), st.sampled_from(SUFFIXES))
    return st.lists(each, min_size=1, max_size=6).map(
        lambda pairs: "".join(f"{kind}{suffix} f{number}\n" for number, (kind, suffix) in enumerate(pairs))
    )


@settings(max_examples=60)
@given(fields(*VALUES, "Inner", "Inner"), fields(*VALUES), st.data())
def test_messages_have_the_bytes_of_another_implementation(outer: str, inner: str, data: st.DataObject) -> None:
    found = parse("p/Outer", f"{outer}{SEPARATOR}\nMSG: p/Inner\n{inner}")
    types, store = RosTypes(2, found), get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(inner, "p/msg/Inner") | get_types_from_msg(outer, "p/msg/Outer"))

    def message(name: str) -> Pair:
        pairs = {field.name: value(field) for field in found[name].fields}
        ours, theirs = ({key: pair[side] for key, pair in pairs.items()} for side in (0, 1))
        return types.load(name)(**ours), store.types[name.replace("/", "/msg/")](**theirs)

    def value(field: FieldDefinition) -> Pair:
        base, count = field.type.base, field.type.count
        if count is None:
            return element(base)
        size = count if field.type.has_fixed_count else data.draw(st.integers(0, count or 5))
        elements = [element(base) for _ in range(size)]
        ours, theirs = tuple(each for each, _ in elements), [each for _, each in elements]
        if base == "string" or base not in VALUES:
            return ours, theirs
        return ours if field.type.has_fixed_count else r2p.Array(ours), numpy.array(theirs, base)

    def element(base: str) -> Pair:
        return (data.draw(VALUES[base]),) * 2 if base in VALUES else message(base)

    ours, theirs = message("p/Outer")
    codec = cdr(types.load("p/Outer"))
    assert codec.encode(ours) == bytes(store.serialize_cdr(theirs, "p/msg/Outer"))
    assert codec.decode(codec.encode(ours)) == ours


class Aligned(r2p.Message, name="robot_msgs/Aligned"):
    a: r2p.f64 = 0.0
    b: r2p.u32 = 0
    c: tuple[r2p.u8, r2p.u8, r2p.u8, r2p.u8] = (0, 0, 0, 0)


class Unaligned(r2p.Message, name="robot_msgs/Unaligned"):
    b: r2p.u32 = 0
    a: r2p.f64 = 0.0


class Twice(r2p.Message, name="robot_msgs/Twice"):
    both: tuple[Aligned, Aligned] = (Aligned(), Aligned())
    last: r2p.u16 = 0


class WithText(r2p.Message, name="robot_msgs/WithText"):
    text: Annotated[str, r2p.Max(10)] = ""


@pytest.mark.parametrize(
    ("message", "size"),
    [
        (Aligned(1.5, 2, (1, 2, 3, 4)), 16),
        (Twice((Aligned(1.5, 2, (1, 2, 3, 4)), Aligned()), 7), 34),
        (Unaligned(1, 2.5), 0),
        (WithText("a"), 0),
    ],
)
def test_messages_whose_packing_is_their_cdr(message: r2p.Message, size: int) -> None:
    """They are not packed once more; of all others something has to be aligned, or they vary."""
    assert packed_size(type(message)) == size
    assert (cdr(type(message)).encode(message) == HEADER + message.encode()) == bool(size)
