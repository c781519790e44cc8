"""Texts. A message has a fixed size, so a short text costs as much as a long one: keep texts off a busy CAN bus."""

from typing import Annotated

from r2p.messages import Len, Message, Timestamp, u8


class Text(Message):
    """A short text. 8 CAN fragments."""

    text: Annotated[str, Len(64)] = ""


class Log(Message):
    """A log record of a node (topic `log` of every module). 19 CAN fragments."""

    stamp: Timestamp = Timestamp()
    """When it was logged, UTC."""
    level: u8 = 0
    """As in Python's logging: 10 debug, 20 info, 30 warning, 40 error, 50 critical."""
    node: Annotated[str, Len(8)] = ""
    """The node that logged it."""
    text: Annotated[str, Len(128)] = ""
