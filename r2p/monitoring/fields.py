"""The numbers in the messages of a topic, as plots take them: which ones a type has, and their values.

A path is that of `r2p topic echo --field`: `pose.x`, `ranges[3]`, `wheels[0].speed`. A `FieldExtractor` takes the
numbers at some paths out of packed messages, without decoding them: of a type of fixed size by one struct, which skips
all other bytes; otherwise by a function that is generated for the type and these paths. It reads no further than the
last of them. Booleans and enums are numbers; an element that an array lacks is NaN.
"""

import itertools
import math
import operator
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeAlias

import msgspec

from r2p.errors import MessageError
from r2p.messages import (
    Chars,
    Field,
    FixedArray,
    Layout,
    Message,
    Nested,
    Scalar,
    Shape,
    VariableArray,
    VariableText,
    layout,
)
from r2p.messages.shapes import COUNT_SIZE
from r2p.messages.values import find_field

FIELDS_MAX = 1000
"""Fields of a type that are listed; types come from the network."""

Columns: TypeAlias = list[Sequence[float]]
"""The values of each path, message by message."""

Steps: TypeAlias = tuple[str | int, ...]
"""The way to a number: names of fields, and indices of elements."""

Wanted: TypeAlias = dict[Steps, int]
"""The numbers of a shape that are wanted, and the place of each in a row."""

_INDEX = re.compile(r"0|[1-9][0-9]{0,8}")
_PATH = re.compile(r"[^.\[\]]+(?:\[[0-9]+\]|\.[^.\[\]]+)*")
_STEP = re.compile(r"[^.\[\]]+")
_SHOWN = 80  # characters of a path in an error
_NAMED = 12  # paths that an error names
_BAD = (struct.error, ValueError)
_TOO_DEEP = (SyntaxError, RecursionError, MemoryError)  # of a compiler that is given too many levels


class FieldDescription(msgspec.Struct, frozen=True, omit_defaults=True):
    """A field of a type. Parts of the elements of an array have [] in their path, where an index has to be put to plot.

    `kind` is that of a number ("u8" to "f64"), "bool", "text", or "message", whose parts follow. Of an array it is that
    of its elements ("array": these are arrays themselves), and it has `length` of them, or `max` at most if that
    varies. A text has at most `limit` bytes.
    """

    path: str
    kind: str
    length: int | None = None
    max: int | None = None
    limit: int | None = None
    plottable: bool = False


def describe_fields(cls: type[Message]) -> list[FieldDescription]:
    """Return the fields of a type in their order, and behind a message its parts; at most `FIELDS_MAX`."""
    return list(itertools.islice(_descriptions(layout(cls).fields, ""), FIELDS_MAX))


def _descriptions(fields: tuple[Field, ...], before: str) -> Iterator[FieldDescription]:
    for field in fields:
        yield from _description(field.shape, before + field.wire_name)


def _description(
    shape: Shape, path: str, length: int | None = None, max: int | None = None
) -> Iterator[FieldDescription]:
    """Yield the description of a field, or of the elements of an array of this length, and of its parts."""
    is_array = length is not None or max is not None
    match shape:
        case FixedArray() | VariableArray() if is_array:
            yield FieldDescription(path, "array", length, max)
            yield from _description(shape, f"{path}[]")
        case FixedArray(item, count):
            yield from _description(item, path, length=count)
        case VariableArray(item, limit):
            yield from _description(item, path, max=limit)
        case Nested(inner):
            yield FieldDescription(path, "message", length, max)
            yield from _descriptions(inner.fields, f"{path}[]." if is_array else f"{path}.")
        case Chars(limit) | VariableText(limit):
            yield FieldDescription(path, "text", length, max, limit)
        case Scalar(kind):
            yield FieldDescription(path, kind, length, max, plottable=True)


class FieldExtractor:
    """Takes the numbers at `paths` out of the messages of a type.

    Raises MessageError, which names the plottable fields, for a path that is not that of a number.
    """

    def __init__(self, cls: type[Message], paths: Sequence[str]) -> None:
        self.cls = cls
        self.paths = tuple(paths)
        self.undecodable = 0
        """Messages that were not of this type."""
        shape = layout(cls)
        steps = [_steps_to(shape, path) for path in self.paths]
        self._read, places = _generated(shape, steps) if shape.varies else _fixed(shape, steps)
        self._places = [places[each] for each in steps]

    def columns(self, times: Sequence[float], messages: Sequence[bytes]) -> tuple[Sequence[float], Columns]:
        """Return times and columns of packed messages; those of another type are counted, and left out."""
        if not self.paths:
            return times, []
        try:
            rows = list(map(self._read, messages))
        except _BAD:
            times, rows = self._good(times, messages)
        if not rows:
            return (), [()] * len(self.paths)
        columns = list(zip(*rows, strict=True))
        return times, [columns[place] for place in self._places]

    def _good(self, times: Sequence[float], messages: Sequence[bytes]) -> tuple[list[float], list[tuple[float, ...]]]:
        good_times, rows = [], []
        for time, message in zip(times, messages, strict=True):
            try:
                rows.append(self._read(message))
            except _BAD:
                self.undecodable += 1
            else:
                good_times.append(time)
        return good_times, rows


def _steps_to(shape: Layout[Any], path: str) -> Steps:
    """Return the steps to the number at a path. Raises MessageError."""
    steps = _find(shape, path) if _PATH.fullmatch(path) else None
    if steps is None:
        raise MessageError(_not_plottable(shape, path))
    return steps


def _find(outer: Layout[Any], path: str) -> Steps | None:
    """Return names of fields and indices of elements; None unless these lead to a number."""
    steps: list[str | int] = []
    shape: Shape = Nested(outer)
    for step in _STEP.findall(path):
        match shape:
            case Nested(inner) if (field := find_field(inner, step)) is not None:
                steps.append(field.name)
                shape = field.shape
            case FixedArray(item, count) | VariableArray(item, count) if _INDEX.fullmatch(step) and int(step) < count:
                steps.append(int(step))
                shape = item
            case _:
                return None
    return tuple(steps) if isinstance(shape, Scalar) else None


def _not_plottable(shape: Layout[Any], path: str) -> str:
    names = [
        each.path if each.length is None and each.max is None else f"{each.path}[]"
        for each in describe_fields(shape.cls)
        if each.plottable
    ]
    more = f", and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    known = ", ".join(names[:_NAMED]) + more if names else "none at all"
    return f"{shape.name} has no number {path[:_SHOWN]!r}; it has {known}"


# Types of fixed size


def _fixed(shape: Layout[Any], wanted: Sequence[Steps]) -> tuple[Callable[[bytes], Any], Wanted]:
    """Return the function that reads all numbers at once, and the place of each in what it returns."""
    found = {steps: _place(Nested(shape), steps) for steps in wanted}
    numbers = sorted(found.values(), key=_offset)
    rows = {offset: place for place, (offset, _) in enumerate(numbers)}
    places = {steps: rows[offset] for steps, (offset, _) in found.items()}
    return struct.Struct(_format(numbers, shape.size)).unpack, places


def _format(numbers: list[tuple[int, Scalar]], size: int | None = None) -> str:
    """Return the format that reads the numbers at these offsets, and skips what is between them."""
    parts, at = ["<"], 0
    for offset, scalar in numbers:
        parts.append(f"{offset - at}x{scalar.format}")
        at = offset + scalar.size
    return "".join(parts) + ("" if size is None else f"{size - at}x")


def _offset(number: tuple[int, Scalar]) -> int:
    return number[0]


def _place(shape: Shape, steps: Steps) -> tuple[int, Scalar]:
    """Return the offset of a number in a shape that does not vary."""
    offset = 0
    for step in steps:
        match shape:
            case Nested(inner):
                for field in inner.fields:
                    if field.name == step:
                        shape = field.shape
                        break
                    offset += field.shape.size
            case FixedArray(item) | VariableArray(item):
                offset += int(step) * item.size
                shape = item
    assert isinstance(shape, Scalar)
    return offset, shape


# Types whose length varies


def _generated(shape: Layout[Any], wanted: Sequence[Steps]) -> tuple[Callable[[bytes], Any], Wanted]:
    """Return the generated function that reads all numbers, and the place of each in what it returns."""
    places = {steps: place for place, steps in enumerate(dict.fromkeys(wanted))}
    source = _ExtractorSource(len(places))
    try:
        source.add(Nested(shape), places)
        file = f"{__file__}, {shape.cls.__name__}"
        exec(compile(source.text(), file, "exec"), source.names)  # noqa: S102 - holds nothing but numbers
    except _TOO_DEEP:
        raise MessageError(f"{shape.name} has too many arrays in arrays to be plotted") from None
    return source.names["read"], places


class _ExtractorSource:
    """The source of a function that reads `count` numbers: runs of fields of fixed size, and what varies in between."""

    def __init__(self, count: int) -> None:
        self.names: dict[str, Any] = {"nan": math.nan, "count": struct.Struct("<I").unpack_from}
        self._count = count
        self._left = count
        """Numbers that are still to be read: what follows the last one is not looked at."""
        self._lines: list[str] = []
        self._indent = 1
        self._numbers: list[tuple[int, Scalar]] = []
        self._slots: list[int] = []
        self._run = 0  # bytes of fixed size since `at`

    def text(self) -> str:
        """Return the source."""
        self._end_run()
        slots = [f"v{index}" for index in range(self._count)]
        begin = ["def read(data):", "    size = len(data)", "    at = 0", f"    {' = '.join(slots)} = nan"]
        return "\n".join([*begin, *self._lines, f"    return {', '.join(slots)},"])

    def add(self, shape: Shape, wanted: Wanted) -> None:
        """Add the reading of a shape: of the numbers that are wanted, and of the way to what follows."""
        if not self._left and self._indent == 1:
            return
        if not shape.varies:
            self._add_fixed(shape, wanted)
            return
        match shape:
            case Nested(inner):
                self._add_fields(inner.fields, wanted)
            case VariableText(limit):
                self._add_count(limit, 1)
                self._add_line("at += n")
            case VariableArray(item, limit) if not item.varies:
                self._add_elements(item, limit, wanted)
            case VariableArray(item, limit):
                self._add_count(limit, item.size_min)
                self._add_each(item, "n", wanted)
            case FixedArray(item, count):
                self._end_run()
                self._add_each(item, str(count), wanted)

    def _add_fields(self, fields: tuple[Field, ...], wanted: Wanted) -> None:
        inside = _by_step(wanted)
        for field in fields:
            self.add(field.shape, inside.get(field.name, {}))

    def _add_fixed(self, shape: Shape, wanted: Wanted) -> None:
        numbers, slots = self._places(shape, wanted)
        self._numbers += [(self._run + offset, scalar) for offset, scalar in numbers]
        self._slots += slots
        self._run += shape.size

    def _places(self, shape: Shape, wanted: Wanted) -> tuple[list[tuple[int, Scalar]], list[int]]:
        """Return the numbers that are wanted of a shape of fixed size, in its order, and the slot of each."""
        found = sorted((*_place(shape, steps), slot) for steps, slot in wanted.items())
        self._left -= len(found)
        return [(offset, scalar) for offset, scalar, _ in found], [slot for *_, slot in found]

    def _add_elements(self, item: Shape, limit: int, wanted: Wanted) -> None:
        """Add an array of elements of fixed size: the numbers of each wanted element by one struct."""
        self._add_count(limit, item.size)
        for index, inside in _by_index(wanted):
            self._add_line(f"if n > {index}:")
            self._indent += 1
            self._add_read(*self._places(item, inside), f"at + {index * item.size}")
            self._indent -= 1
        self._add_line(f"at += n * {item.size}")

    def _add_each(self, item: Shape, count: str, wanted: Wanted) -> None:
        """Add a loop over elements whose length varies."""
        index = f"i{len(self._lines)}"  # loops may be nested
        self._add_line(f"for {index} in range({count}):")
        self._indent += 1
        word = "if"
        for each, inside in _by_index(wanted):
            self._add_line(f"{word} {index} == {each}:")
            self._add_block(item, inside)
            word = "elif"
        if wanted:
            self._add_line("else:")
            self._add_block(item, {})
        else:
            self.add(item, {})
            self._end_run()
        self._indent -= 1

    def _add_block(self, item: Shape, wanted: Wanted) -> None:
        self._indent += 1
        self.add(item, wanted)
        self._end_run()
        self._indent -= 1

    def _add_count(self, limit: int, least: int) -> None:
        """Add the reading of a count of elements with `least` bytes each; it is not believed beyond the message."""
        self._end_run()
        self._add_line("n, = count(data, at)")
        self._add_line(f"at += {COUNT_SIZE}")
        self._add_line(f"if n > {limit} or n * {least} > size - at: raise ValueError")

    def _end_run(self) -> None:
        """Read the fields since the last thing that varies by one struct."""
        if self._numbers:
            self._add_read(self._numbers, self._slots, "at")
        if self._run:
            self._add_line(f"at += {self._run}")
        self._numbers, self._slots, self._run = [], [], 0

    def _add_read(self, numbers: list[tuple[int, Scalar]], slots: list[int], where: str) -> None:
        name = f"unpack{len(self.names)}"
        self.names[name] = struct.Struct(_format(numbers)).unpack_from
        self._add_line(f"{', '.join(f'v{slot}' for slot in slots)}, = {name}(data, {where})")

    def _add_line(self, line: str) -> None:
        self._lines.append("    " * self._indent + line)


def _by_step(wanted: Wanted) -> dict[str | int, Wanted]:
    """Return what is wanted behind each step."""
    inside: dict[str | int, Wanted] = {}
    for steps, slot in wanted.items():
        inside.setdefault(steps[0], {})[steps[1:]] = slot
    return inside


def _by_index(wanted: Wanted) -> list[tuple[int, Wanted]]:
    """Return the elements of an array of which something is wanted, in their order, and what that is."""
    return sorted(((int(step), inside) for step, inside in _by_step(wanted).items()), key=operator.itemgetter(0))
