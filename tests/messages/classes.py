"""Message classes that hold every kind of field."""

import types
from typing import Annotated, Any

from r2p.messages import Len, Message, Timestamp, f32, f64, i8, i16, i32, i64, u8, u16, u32, u64


def define(name: str, fields: list[tuple[str, Any]]) -> Any:
    """A message class with these names and annotations, all required."""
    namespace = {"__annotations__": dict(fields), "__module__": __name__}
    return types.new_class(name, (Message,), {}, lambda empty: empty.update(namespace))


class Numbers(Message):
    a: u8
    b: u16
    c: u32
    d: u64
    e: i8
    f: i16
    g: i32
    h: i64
    i: f32
    j: f64
    k: bool


class Wheel(Message):
    speed: f32 = 0.0
    ok: bool = False
    name: Annotated[str, Len(4)] = ""


class Robot(Message):
    stamp: Timestamp = Timestamp()
    wheels: tuple[Wheel, Wheel] = (Wheel(), Wheel())
    grid: tuple[tuple[u8, u8, u8], tuple[u8, u8, u8]] = ((0, 0, 0), (0, 0, 0))
    names: Annotated[tuple[Annotated[str, Len(3)], ...], Len(2)] = ("", "")
    flags: tuple[bool, bool] = (False, False)
    serial: Annotated[tuple[u8, ...], Len(16)] = (0,) * 16
    best: Wheel = Wheel()


class Keywords(Message, kw_only=True):
    a: u8 = 0
    b: Timestamp


class Derived(Keywords):
    c: i16 = 0


class Redefined(Derived):
    d: u8 = 0
    b: u32 = 0  # type: ignore[assignment]  # keeps its place on the wire, whatever it is
