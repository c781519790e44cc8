"""One struct for a whole message of variable length, where the message before it had the same lengths.

A laser scanner measures as many ranges each time. When two messages in a row have the same counts, `decode` keeps one
`struct.Struct` for messages of their size, which unpacks all runs at once. It still compares each count: the first one
is at the same place in every message, and each further one is where it is expected if those before it are right.

Threads may decode messages of one class at the same time: all of them share what is kept, none relies on what it was a
moment ago.
"""

import struct
from collections.abc import Callable
from typing import Any

import msgspec

SHORT_TEXT = 256
"""Bytes of the longest text for which `encode` keeps a struct for each length: that of a frame id."""

_SIZES_MAX = 16  # sizes with a struct: more than the scanners of a robot have
_ELEMENTS_MIN = 2  # arrays and texts of a message for which one struct is faster

_DECODE = """
if known := find(size):
    unpack, {expected} = known
    {slots}, = unpack(data)
    if {equal}:
        {read}
        return {value}
"""
_LEARN = """
counts = {counts}
if recent[0] == counts:
    learn(size, counts)
else:
    recent[0] = counts
"""


class Elements(msgspec.Struct, frozen=True):
    """Elements behind their count: `count` and `value` are the slots of both in the source.

    The value is the bytes, with `convert` behind them. `read`, if there is one, are statements that make it instead,
    with `{place}` for the place of the bytes in `data`; then a struct skips them.
    """

    count: str
    value: str
    item_size: int
    convert: str
    read: str

    def lines(self, place: str) -> list[str]:
        """Return the statements that make the value of the bytes at a place."""
        if not self.read:
            return [f"{self.value} = data[{place}]{self.convert}"]
        return self.read.format(count=self.count, value=self.value, place=place).splitlines()


class KnownLengths:
    """The fields of a message in their order, as source for its `decode`; then the structs by the size of messages."""

    def __init__(self) -> None:
        self._fields: list[str | Elements] = []  # formats of what is between elements
        self._slots: list[str] = []
        self._has_parts = False
        self._sizes: dict[int, tuple[Any, ...]] = {}
        self._recent: list[tuple[int, ...]] = [()]  # the counts of the last message that was not of a known size

    @property
    def names(self) -> dict[str, Any]:
        """The names that the source uses."""
        return {"find": self._sizes.get, "recent": self._recent, "learn": self._learn}

    def add_run(self, formats: list[str], slots: list[str]) -> None:
        """Add fields of fixed size."""
        self._fields.append("".join(formats))
        self._slots += slots

    def add_elements(self, elements: Elements) -> None:
        """Add elements behind the run that ends with their count."""
        self._fields.append(elements)
        if not elements.read:
            self._slots.append(elements.value)

    def add_part(self) -> None:
        """Note that the message has a part with lengths of its own, so that no struct can be kept."""
        self._has_parts = True

    def source(self, value: str) -> tuple[list[str], list[str]]:
        """Return the lines before and behind those that decode any message; `value` is the message of the slots.

        Both are empty where a struct for the whole message would not be faster.
        """
        elements = [each for each in self._fields if isinstance(each, Elements)]
        if self._has_parts or len(elements) < _ELEMENTS_MIN:
            return [], []
        read: list[str] = []
        expected = [f"expected{i}" for i in range(len(elements))]
        for i, each in enumerate(elements):
            if each.read:
                expected.append(f"place{i}")
                read += each.lines(f"place{i}")
            elif each.convert:
                read.append(f"{each.value} = {each.value}{each.convert}")
        fast = _DECODE.format(
            expected=", ".join(expected),
            slots=", ".join(self._slots),
            equal=" and ".join(f"{each.count} == expected{i}" for i, each in enumerate(elements)),
            read="\n        ".join(read),
            value=value,
        )
        learn = _LEARN.format(counts=", ".join(each.count for each in elements))
        return fast.strip().splitlines(), learn.strip().splitlines()

    def _learn(self, size: int, counts: tuple[int, ...]) -> None:
        """Keep the struct of messages of this size with these counts, which a message had that was decoded."""
        expected = iter(counts)
        formats, places, at = [], [], 0
        for each in self._fields:
            if isinstance(each, str):
                formats.append(each)
                at += struct.calcsize("<" + each)
                continue
            length = next(expected) * each.item_size
            formats.append(f"{length}{'x' if each.read else 's'}")
            if each.read:
                places.append(slice(at, at + length))
            at += length
        if len(self._sizes) >= _SIZES_MAX:
            self._sizes.clear()
        self._sizes[size] = struct.Struct("<" + "".join(formats)).unpack, *counts, *places


class StructsWithText(dict[int, Callable[..., bytes]]):
    """By the length of a short text, the function that packs it with the fields before and behind it."""

    def __init__(self, before: str, behind: str) -> None:
        super().__init__()
        self._before = before
        self._behind = behind

    def __missing__(self, length: int) -> Callable[..., bytes]:
        pack = self[length] = struct.Struct(f"<{self._before}{length}s{self._behind}").pack
        return pack
