"""Message classes as a module writes them whose annotations stay text."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from r2p.messages import Len, Message, Timestamp, u8, u16

if TYPE_CHECKING:
    from r2p.msg import Led


class Stamped(Message):
    stamp: Timestamp = Timestamp()
    names: tuple[Annotated[str, Len(4)], Annotated[str, Len(4)]] = ("", "")


class Endless(Message):
    x: u8
    inner: Endless


def local() -> type[Message]:
    class Local(Message):
        a: u16
        s: Stamped

    return Local


def names_a_local() -> type[Message]:
    class Inner(Message):
        x: u8

    class Outer(Message):
        inner: Inner

    return Outer


def names_a_type_checking_import() -> type[Message]:
    class Outer(Message):
        led: Led

    return Outer
