"""`r2p.Array`: the elements of an array field, as a read-only view of packed bytes.

A tuple of a million numbers is a million objects. An `Array` has the bytes instead, and makes a number when it is
asked for one; numpy and `memoryview` use the bytes as they are.
"""

import array
import functools
import operator
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeVar, overload

T = TypeVar("T")

_NOTHING: tuple[Any, ...] = ()
_SHOWN = 3  # elements that `repr` shows
_LITTLE_ENDIAN = ("", "@", "=", "<")  # in front of the letter of a format
_CODES: tuple[tuple[str, dict[int, Literal["?", "b", "B", "h", "H", "i", "I", "q", "Q", "f", "d"]]], ...] = (
    ("fd", {4: "f", 8: "d"}),
    ("bhilqn", {1: "b", 2: "h", 4: "i", 8: "q"}),
    ("BHILQN", {1: "B", 2: "H", 4: "I", 8: "Q"}),
    ("?", {1: "?"}),
)
"""Letters of the formats of buffers, and the one of them that Scalar has, by the bytes of a number."""


class Array(Sequence[T]):
    """An immutable sequence of numbers with the buffer protocol: `numpy.asarray(a)` and `memoryview(a)` copy nothing.

    Annotate a field with `Annotated[r2p.Array[r2p.f32], r2p.Max(1000)]`; its messages hold an Array when they arrive.
    To publish one, anything will do that has a buffer of the right kind of numbers, or is a sequence of numbers. Wrap
    it in `Array(...)` for type checkers. Equal to every sequence with the same elements.
    """

    __slots__ = ("_code", "_view")  # in this order for Python 3.11, see below

    def __init__(self, values: Iterable[T] | Any = _NOTHING) -> None:
        """Hold the elements: of the buffer of `values`, which is not copied, else of an iterable of numbers.

        Integers are held as i64 or u64, other numbers as f64. Raises TypeError or OverflowError for anything else.
        """
        if values is not _NOTHING:  # the default of many fields: a class is to be defined without the cost of this
            enable_buffers()
        view = buffer_of(values)
        self._view = (_pack(values) if view is None else view).toreadonly()
        self._code = self._view.format

    @property
    def view(self) -> memoryview:
        """The elements as a read-only memoryview."""
        return self._view

    def __len__(self) -> int:
        return len(self._view)

    def __iter__(self) -> Iterator[T]:
        return iter(self._view)  # type: ignore[arg-type]  # of the type that the view's format says

    @overload
    def __getitem__(self, index: int) -> T: ...

    @overload
    def __getitem__(self, index: slice) -> "Array[T]": ...

    def __getitem__(self, index: int | slice) -> Any:
        found = self._view[index]
        if not isinstance(index, slice):
            return found
        return Array(found)

    def tolist(self) -> list[T]:
        """Return the elements as a list."""
        return self._view.tolist()  # type: ignore[return-value]

    def tobytes(self) -> bytes:
        """Return the elements as bytes, as they are on the wire."""
        return self._view.tobytes()

    def __bytes__(self) -> bytes:
        return self._view.tobytes()

    def __eq__(self, other: object) -> bool:
        if isinstance(other, Array):
            return self._view == other._view
        if isinstance(other, Sequence) and not isinstance(other, str):
            return len(self._view) == len(other) and all(map(operator.eq, self._view, other))
        return NotImplemented

    def __hash__(self) -> int:
        return hash(tuple(self._view))  # that of an equal tuple

    def __repr__(self) -> str:
        shown = ", ".join(map(repr, self._view[:_SHOWN]))
        return f"Array([{shown}, ... {len(self)} in all])" if len(self) > _SHOWN else f"Array([{shown}])"

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickle, (self._view.tobytes(), self._code)

    if TYPE_CHECKING or sys.version_info >= (3, 12):

        def __buffer__(self, flags: int) -> memoryview:
            return self._view


@functools.cache
def enable_buffers() -> None:
    """Give Arrays their buffer, before the first one with elements is made.

    Only from 3.12 on can a class in Python have one (PEP 688). `pickle.PickleBuffer` hands out the buffer of an object
    that it keeps behind its first field, where an Array has `_view`, its second slot: so its functions serve.
    """
    if sys.version_info >= (3, 12):
        return
    import ctypes
    from pickle import PickleBuffer

    offset = 20 * ctypes.sizeof(ctypes.c_void_p)  # of `tp_as_buffer` in a type of CPython 3.11
    functions = ctypes.c_void_p.from_address(id(PickleBuffer) + offset)
    ctypes.c_void_p.from_address(id(Array) + offset).value = functions.value


def from_view(view: memoryview, code: str) -> Array[Any]:
    """Make an Array of a read-only view of one dimension, with the format `code`: the fast way."""
    made: Array[Any] = _new(Array)
    made._view = view  # noqa: SLF001 - in place of the constructor, as below
    made._code = code  # noqa: SLF001
    return made


_new = object.__new__


def _unpickle(data: bytes, code: Any) -> "Array[Any]":
    return Array(memoryview(data).cast(code))


def buffer_of(values: Any) -> Any:
    """Return the numbers in the buffer of an object, in a row; None if it has no buffer, or one of anything else.

    The format is that of `Scalar`: C has several letters for integers of one size.
    """
    if values.__class__ is Array:
        return values._view  # noqa: SLF001
    if isinstance(values, list | tuple):
        return None
    try:
        view = memoryview(values)
    except TypeError:
        return None
    order, letter = view.format[:-1], view.format[-1]
    code = next((codes.get(view.itemsize) for letters, codes in _CODES if letter in letters), None)
    if code is None or order not in _LITTLE_ENDIAN:
        return None
    if view.format == code and view.ndim == 1 and view.contiguous:
        return view
    data = view if view.c_contiguous and not order else memoryview(view.tobytes())
    return data.cast("B").cast(code)


def _pack(values: Iterable[Any]) -> memoryview:
    """Put numbers into a buffer."""
    numbers = list(values)
    for code in ("q", "Q") if all(isinstance(each, int) for each in numbers) else ("d",):
        try:
            return memoryview(array.array(code, numbers).tobytes()).cast(code)
        except OverflowError as error:
            failure = error
    raise failure
