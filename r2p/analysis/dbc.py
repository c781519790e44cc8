"""Message sets as DBC files, the format in which car makers describe CAN buses. Reading needs cantools.

A DBC file has names, identifiers, lengths, senders and cycle times (`GenMsgCycleTime`, whole ms). What else the
analysis needs is in attributes of our own: `R2PPeriod`, `R2PDeadline` and `R2PJitter` in ms, and for messages of RTCAN
`R2PClass` and `R2PBytes`. Other programs ignore them. An RTCAN message is listed with the identifier of its first
frame, with the laxity that it has when it is published. Names of messages become identifiers of C, with the name itself
in `R2PName`; those of nodes stay so.
"""

import re
from collections.abc import Iterable
from typing import Any

from r2p.analysis.messages import BusMessage, MessageClass, check_message
from r2p.analysis.tables import MessageSet
from r2p.codecs import rtcan
from r2p.codecs.can_bits import EXTENDED, FRAME_MAX
from r2p.errors import Error, MessageError
from r2p.units import MILLISECOND

_NAME_MAX = 32  # characters of a name in a DBC file
_NOT_SENT = "VECTOR__INDEPENDENT_SIG_MSG"  # what holds signals that are in no message
_NO_NODE = "Vector__XXX"
_BITRATE_MIN = 10_000  # less is in kbit/s
_ATTRIBUTES = """BA_DEF_ "Baudrate" INT 0 1000000;
BA_DEF_ BO_ "GenMsgCycleTime" INT 0 3600000;
BA_DEF_ BO_ "R2PPeriod" FLOAT 0 1000000000;
BA_DEF_ BO_ "R2PDeadline" FLOAT 0 1000000000;
BA_DEF_ BO_ "R2PJitter" FLOAT 0 1000000000;
BA_DEF_ BO_ "R2PBytes" INT 0 1024;
BA_DEF_ BO_ "R2PClass" STRING;
BA_DEF_ BO_ "R2PName" STRING;
BA_DEF_DEF_ "Baudrate" 0;
BA_DEF_DEF_ "GenMsgCycleTime" 0;
BA_DEF_DEF_ "R2PPeriod" 0;
BA_DEF_DEF_ "R2PDeadline" 0;
BA_DEF_DEF_ "R2PJitter" 0;
BA_DEF_DEF_ "R2PBytes" 0;
BA_DEF_DEF_ "R2PClass" "can";
BA_DEF_DEF_ "R2PName" "";
"""


def read_dbc(text: str) -> MessageSet:
    """Return the messages of a DBC file, and the bit rate if it has one.

    Raises Error without cantools, and `MessageError` for a file that is none, or one with frames of CAN FD.
    """
    try:
        from cantools.database import load_string
    except ImportError as error:
        raise Error("DBC files need cantools: pip install 'r2p[dbc]'") from error
    try:
        database: Any = load_string(text, "dbc", strict=False)
    except Exception as error:
        raise MessageError(f"not a DBC file: {error}") from error
    messages = [each for each in database.messages if each.name != _NOT_SENT]
    if long := [each.name for each in messages if each.length > FRAME_MAX]:
        raise MessageError(f"{long[0]} and {len(long) - 1} others are frames of CAN FD, which has no analysis here")
    bitrate = _attribute(database, "Baudrate") or 0
    return MessageSet([_message(each) for each in messages], bitrate=bitrate if bitrate >= _BITRATE_MIN else None)


def _message(found: Any) -> BusMessage:
    kind = MessageClass(_attribute(found, "R2PClass") or "can")
    period = _time(found, "R2PPeriod") or (found.cycle_time or 0) * MILLISECOND or None
    plain = kind is MessageClass.PLAIN
    return check_message(
        BusMessage(
            name=_attribute(found, "R2PName") or found.name,
            size=_attribute(found, "R2PBytes") or found.length,
            period=period,
            deadline=_time(found, "R2PDeadline") or (None if kind is MessageClass.NRT else period),
            jitter=_time(found, "R2PJitter"),
            node=next(iter(found.senders), ""),
            id=found.frame_id if plain else rtcan.message_of(found.frame_id),
            extended=found.is_extended_frame if plain else False,
            message_class=kind,
        )
    )


def _attribute(found: Any, name: str) -> Any:
    attributes = found.dbc.attributes if found.dbc is not None else {}
    return attributes[name].value if name in attributes else None


def _time(found: Any, name: str) -> int:
    return round((_attribute(found, name) or 0) * MILLISECOND)


def write_dbc(messages: Iterable[BusMessage], bitrate: int | None = None) -> str:
    """Return messages as a DBC file. It needs no library. Raises `MessageError` if two have the same identifier."""
    messages = list(messages)
    names = _unique([each.name for each in messages])
    nodes = _unique(list(dict.fromkeys(each.node for each in messages if each.node)))
    by_node = dict(zip(dict.fromkeys(each.node for each in messages if each.node), nodes, strict=True))
    identifiers = [_identifier(each) for each in messages]
    for index, identifier in enumerate(identifiers):
        if (first := identifiers.index(identifier)) != index:
            raise MessageError(f"{messages[first].name} and {messages[index].name} have the same identifier")
    lines = ['VERSION ""', "", "NS_ :", "", "BS_:", "", f"BU_: {' '.join(nodes)}", ""]
    for each, name, identifier in zip(messages, names, identifiers, strict=True):
        sender = by_node.get(each.node, _NO_NODE)
        lines += [f"BO_ {identifier} {name}: {min(each.size, FRAME_MAX)} {sender}", ""]
    values = [f'BA_ "Baudrate" {bitrate};'] if bitrate else []
    for each, name, identifier in zip(messages, names, identifiers, strict=True):
        values += [f'BA_ "{key}" BO_ {identifier} {value};' for key, value in _values(each, name)]
    return "\n".join(lines) + "\n" + _ATTRIBUTES + "\n".join(values) + "\n"


def _values(message: BusMessage, name: str) -> list[tuple[str, str]]:
    """Return the attributes of a message that are not the default."""
    found: list[tuple[str, str]] = []
    if message.period is not None:
        if not message.period % MILLISECOND:
            found.append(("GenMsgCycleTime", str(message.period // MILLISECOND)))
        found.append(("R2PPeriod", _milliseconds(message.period)))
    if message.deadline is not None:
        found.append(("R2PDeadline", _milliseconds(message.deadline)))
    if message.jitter:
        found.append(("R2PJitter", _milliseconds(message.jitter)))
    if message.message_class is not MessageClass.PLAIN:
        found += [("R2PClass", f'"{message.message_class.value}"'), ("R2PBytes", str(message.size))]
    if message.name != name:
        escaped = message.name.replace("\\", "").replace('"', "")
        found.append(("R2PName", f'"{escaped}"'))
    return found


def _milliseconds(time: int) -> str:
    return f"{time / MILLISECOND:.12g}"


def _identifier(message: BusMessage) -> int:
    """Return the identifier as DBC files write it: with a bit for 29 bits."""
    if message.message_class is MessageClass.PLAIN:
        return message.id | (EXTENDED if message.extended else 0)
    laxity = {MessageClass.HRT: rtcan.HRT, MessageClass.NRT: rtcan.NRT}.get(message.message_class)
    if laxity is None:
        laxity = rtcan.srt_laxity(message.deadline or message.period or 0)
    return rtcan.encode_identifier(laxity, message.id, message.frames - 1) | EXTENDED


def _unique(names: list[str]) -> list[str]:
    """Return names that a DBC file may have: identifiers of C, all of them different."""
    found: list[str] = []
    for name in names:
        plain = re.sub(r"\W", "_", name, flags=re.ASCII)[:_NAME_MAX]
        plain = plain if re.match(r"[A-Za-z_]", plain) else f"_{plain}"[:_NAME_MAX]
        number = 1
        unique = plain
        while unique in found:
            number += 1
            unique = f"{plain[: _NAME_MAX - 1 - len(str(number))]}_{number}"
        found.append(unique)
    return found
