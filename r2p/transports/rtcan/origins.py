"""Who is behind a message id on an RTCAN bus, as far as discovery has heard.

A management message names its sender's id8 on the bus; only firmware of 2014 does not: all its modules send with one
id, 0. Where r2p modules have to do the same (profile firmware-2014), they mark what firmware sends as well, in params
that mean nothing to it. So the two kinds have an address each, and firmware's subscriptions can outlive r2p's leases.
"""

from r2p.codecs import management, rtcan
from r2p.codecs.management import ROLE_PUBLISHES
from r2p.protocols.discovery import Discovery
from r2p.protocols.events import ModuleInfo
from r2p.sample import Source

FIRMWARE = 0
"""The address of all firmware modules of 2014."""
R2P = 256
"""The address of all r2p modules in a network of theirs."""

_MARK = b"r2p"
_MARKED = slice(22, 25)  # of a management message with params, which are bytes 20 to 29: behind the message id
_WITH_PARAMS = range(0x21, 0x24)  # ADVERTISE, SUBSCRIBE_REQUEST, SUBSCRIBE_RESPONSE
_ALIVE, _ADVERTISE, _RESPONSE = 0x11, 0x21, 0x23
_OURS = 0x40  # from here on types are r2p's


def mark(data: bytes) -> bytes:
    """A management message of ours for a bus where its sender is not told by its id."""
    if data[-1] not in _WITH_PARAMS:
        return data
    return data[: _MARKED.start] + _MARK + data[_MARKED.stop :]


def unmark(data: bytes) -> bytes:
    """Take the mark away."""
    if data[-1] not in _WITH_PARAMS or data[_MARKED] != _MARK:
        return data
    return data[: _MARKED.start] + bytes(len(_MARK)) + data[_MARKED.stop :]


def address(data: bytes, modules: dict[str, ModuleInfo]) -> int:
    """Which kind of module sent this management message with the id of firmware. `modules` are those known."""
    kind = data[-1]
    if kind in _WITH_PARAMS:
        ours = data[_MARKED] == _MARK
    elif kind == _ALIVE:
        known = modules.get(data[:7].rstrip(b"\0").decode("ascii", "replace"))
        ours = known is not None and known.r2p
    else:
        ours = kind >= _OURS
    return R2P if ours else FIRMWARE


def message_of(params: bytes) -> int:
    """The message id in the params of a SUBSCRIBE_RESPONSE."""
    return int.from_bytes(params[:2], "little")


def params_of(message: int) -> bytes:
    """Params with this message id."""
    return message.to_bytes(2, "little").ljust(len(management.NO_PARAMS), b"\0")


def publisher_in(data: bytes, source: int) -> tuple[str, int] | None:
    """Topic and message id of a publisher that a management message of this address offers, if it can be true.

    Publishers of r2p tell it in all that they offer, those of firmware only when asked.
    """
    kind, message = data[-1], message_of(data[20:22])
    if kind != _RESPONSE and (kind != _ADVERTISE or source == FIRMWARE):
        return None
    shared = source in (FIRMWARE, R2P)
    if rtcan.high_byte(message) < rtcan.FIRST_TOPIC or not (shared or rtcan.id8_of(message) == source):
        return None
    return data[:16].partition(b"\0")[0].decode("ascii", "replace"), message


class Origins:
    """The source of samples by topic and message id, worked out anew when something is learnt."""

    def __init__(self, discovery: Discovery, link: str) -> None:
        self._discovery = discovery
        self._link = link
        self._known: dict[tuple[str, int], Source] = {}
        self._generation = -1

    def of(self, topic: str, message: int) -> Source:
        """Empty names for what was not heard, and for what may be one or another."""
        if self._generation != self._discovery.generation:
            self._generation = self._discovery.generation
            self._known.clear()
        source = self._known.get((topic, message))
        if source is None:
            source = self._known[topic, message] = self._find(topic, rtcan.id8_of(message))
        return source

    def _find(self, topic: str, id8: int) -> Source:
        everybody = self._discovery.modules.values()
        direct = [info for info in everybody if info.source == id8]
        modules = direct or [info for info in everybody if info.source in (FIRMWARE, R2P)]
        names: dict[int | None, str] = {info.instance: info.name for info in modules if info.r2p}
        publishers = {
            (names[each.instance], each.node)
            for each in self._discovery.endpoints.values()
            if each.topic == topic and each.role == ROLE_PUBLISHES and each.instance in names
        }
        if len(publishers) == 1:
            return Source(*publishers.pop(), self._link)
        candidates = {module for module, _ in publishers} or {info.name for info in modules if not info.observer}
        return Source(candidates.pop() if len(candidates) == 1 else "", "", self._link)
