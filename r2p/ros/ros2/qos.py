"""The quality of service in rmw_zenoh's tokens, and what a difference between two endpoints means.

    RELIABILITY:DURABILITY:HISTORY,DEPTH:DEADLINE:LIFESPAN:LIVELINESS,LEASE

Numbers are those of ROS: reliability 1 reliable, 2 best effort; durability 1 transient local, 2 volatile; history 1
keep last, 2 keep all. A time is `seconds,nanoseconds`. A field is empty where it has its default: reliable, volatile,
keep last, and no limit of time. Liveliness is always automatic here, and that of other endpoints is not used.
"""

import re

from r2p.errors import DecodeError
from r2p.ros.middleware import Qos

_SECOND = 1_000_000_000
_FIELDS_MIN, _FIELDS_MAX = 3, 6
_DEFAULT_DEPTH = 10
_DEPTH_MAX = 2**31
_INFINITE_S, _INFINITE_NS = 9_223_372_036, 854_775_807  # as ROS writes a time without a limit
_NUMBER = re.compile(r"[0-9]{0,19}")
_CHOICES = ("", "1", "2")


def encode_qos(qos: Qos) -> str:
    """Return the field of a token."""
    history = f",{qos.depth}" if qos.depth else "2,"
    reliability, durability = "" if qos.reliable else "2", "1" if qos.transient_local else ""
    return f"{reliability}:{durability}:{history}:{_encode_time(qos.deadline)}:{_encode_time(qos.lifespan)}:,,"


def decode_qos(text: str) -> Qos:
    """Return the QoS in a token's field; missing fields have their default. Raises DecodeError."""
    fields = text.split(":")
    if not _FIELDS_MIN <= len(fields) <= _FIELDS_MAX:
        raise DecodeError(f"{text[:80]!r} is not a quality of service")
    reliability, durability = fields[:2]
    history, _, depth = fields[2].partition(",")
    if {reliability, durability, history} - {*_CHOICES}:
        raise DecodeError(f"{text[:80]!r} is a quality of service with unknown numbers")
    times = [_decode_time(each) for each in fields[3:5]] + [0, 0]
    keep = 0 if history == "2" else min(_number(depth, _DEFAULT_DEPTH), _DEPTH_MAX)
    return Qos(reliability != "2", durability == "1", keep, times[0], times[1])


def lost_between(publisher: Qos, subscriber: Qos) -> str:
    """Return what a subscriber asks for that a publisher does not give, and what to change; empty if it gets all.

    They are connected all the same: rmw_zenoh refuses none, unlike DDS.
    """
    texts = []
    if subscriber.transient_local and not publisher.transient_local:
        texts.append(
            "the publisher is volatile, so a subscriber that joins later does not get the last message: make the "
            "publisher transient local (latched), or the subscriber volatile"
        )
    if subscriber.reliable and not publisher.reliable:
        texts.append(
            "the publisher is best effort, so messages may be lost: make the publisher reliable, or the subscriber "
            "best effort"
        )
    return "; ".join(texts)


def _encode_time(time: int) -> str:
    return f"{time // _SECOND},{time % _SECOND}" if time else ","


def _decode_time(text: str) -> int:
    """Return a time in ns, 0: no limit."""
    seconds, _, rest = text.partition(",")
    whole = _number(seconds, _INFINITE_S)
    return 0 if whole >= _INFINITE_S else whole * _SECOND + _number(rest, _INFINITE_NS)


def _number(text: str, default: int) -> int:
    if not _NUMBER.fullmatch(text):
        raise DecodeError(f"{text[:40]!r} is not a number in a quality of service")
    return int(text) if text else default
