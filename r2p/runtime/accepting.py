"""Types that grow: `subscribe(..., accept={OldScan: upgrade})` receives messages of older types, and converts them.

Such a subscription asks for its topic without a type, so that publishers of each of them send. Discovery refuses those
that have announced yet another one; of a gateway, which asks for what others want as well, each message is judged here.
The type of a message is the one that its publisher has announced. Of a publisher that has not, as firmware, only the
length tells it.
"""

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

from r2p.codecs.management import ANY_TYPE
from r2p.errors import DecodeError, MessageError
from r2p.messages import Layout, Message, layout, show

Accept: TypeAlias = Mapping[type[Any], Callable[[Any], Any]]
"""Functions that convert messages of other types, by type."""


class AcceptedTypes:
    """The type of a subscription, and the others that it accepts. Raises MessageError for options that can't be."""

    def __init__(self, topic: str, own: Layout[Any] | None, accept: Accept) -> None:
        if own is None:
            raise MessageError(f"topic {topic}: accept= needs the type to which it converts, not None")
        self._topic = topic
        self._own = own
        self._converters: dict[bytes, Callable[[Any], Any]] = {}
        self._layouts = {own.fingerprint: own}
        for cls, convert in accept.items():
            self._add(layout(cls), convert)

    def _add(self, other: Layout[Any], convert: Callable[[Any], Any]) -> None:
        if not callable(convert):
            raise MessageError(
                f"topic {self._topic}: accept= takes a function for each type, as in "
                f"{{{other.cls.__name__}: convert}}, not {show(convert)}"
            )
        if other.fingerprint in self._layouts:
            raise MessageError(
                f"topic {self._topic}: {other.cls.__name__} in accept= has the same fields as "
                f"{self._layouts[other.fingerprint].cls.__name__}: leave it out"
            )
        self._layouts[other.fingerprint] = other
        self._converters[other.fingerprint] = convert

    @property
    def layouts(self) -> list[Layout[Any]]:
        """The types, that of the subscription first."""
        return list(self._layouts.values())

    @property
    def size(self) -> int:
        """Bytes of the longest message of all types."""
        return max(each.size for each in self._layouts.values())

    def accepts(self, other: Layout[Any]) -> bool:
        """Return whether messages of this type are accepted."""
        return other.fingerprint in self._layouts

    def decode(self, data: bytes, fingerprint: bytes) -> Message:
        """Decode a message of a publisher with this type, ANY_TYPE: unknown. Raises DecodeError."""
        if fingerprint == ANY_TYPE:
            sized = [each for each in self._layouts.values() if each.exact_size == len(data)]
            found: Layout[Any] | None = sized[0] if sized else self._own
        else:
            found = self._layouts.get(fingerprint)
        if found is None:
            raise DecodeError(f"a message of another type than {self.names}")
        message: Message = found.decode(data)
        return message

    def convert(self, message: Message) -> Any:
        """Return a message as one of the subscription's type. Raises DecodeError if its type is not accepted."""
        if message.__class__ is self._own.cls:
            return message
        theirs: Layout[Any] = layout(type(message))
        if theirs.fingerprint == self._own.fingerprint:
            return self._own.decode(theirs.encode(message))
        convert = self._converters.get(theirs.fingerprint)
        if convert is None:
            raise DecodeError(f"a message of another type than {self.names}")
        accepted = self._layouts[theirs.fingerprint]
        if accepted.cls is not message.__class__:  # another class with the same fields
            message = accepted.decode(theirs.encode(message))
        made = convert(message)
        if made.__class__ is not self._own.cls:
            raise MessageError(
                f"topic {self._topic}: the function in accept= for {accepted.cls.__name__} has to return a "
                f"{self._own.cls.__name__}, not {show(made)}"
            )
        return made

    @property
    def names(self) -> str:
        """The names of the classes."""
        return ", ".join(each.cls.__name__ for each in self._layouts.values())
