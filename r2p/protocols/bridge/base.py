"""What the tree, its clients and modules with several links share: timings, ports, and acknowledgements."""

import enum
import struct
from collections import Counter, deque

import msgspec

from r2p.codecs.management import Bridge, Leaf, Mesh
from r2p.protocols.bridge.mesh import Place

_MS = 1_000_000

TICK = 80 * _MS
"""Ns between two BRIDGE where there are other gateways."""
TICK_ALONE = 200 * _MS
TICK_LISTENING = 50 * _MS
LEASE = 600 * _MS
"""How long an acknowledgement holds, from when what it acknowledges was sent."""
DEAD = 650 * _MS
"""A gateway that was silent for so long is gone."""
LISTEN = 800 * _MS
"""A new port is silent for so long, but for hellos."""
SETTLE = 300 * _MS
"""Between agreement and forwarding; no message may take longer from its publisher to the last gateway."""
PROBE = 2_000 * _MS
"""Between two probes for loops through gateways that know nothing of this."""
PROBE_MEMORY = 7_000 * _MS
PROBE_PROVEN = 300 * _MS
"""A gateway of which only a probe was heard for so long is not on this network itself."""
STRANGE_PROBES = 256
"""Probes of gateways in no mesh of ours that are kept for each port."""

MOST_PORTS = 250
"""Ports that other gateways may use."""

CLIENTS = 250
"""The number under which all clients share one port of the tree (`clients`)."""

FLAPS = 8
"""Neighbours that may go before newcomers have to wait."""
FLAP_FORGIVEN = 10_000 * _MS
"""Ns after which one of those is forgotten."""

APART = 10 * _MS
"""Between two hellos at least, for those out of turn."""
FOR_EVER = 1 << 62
ACK = struct.Struct("<IH")
BRIDGE_ACKS = 2
LEAVES = 32  # on one network; more than these use one link only


class PortState(enum.Enum):
    """What a port does."""

    LISTENING = "listening"
    ALONE = "alone"
    CONVERGING = "converging"
    FORWARDING = "forwarding"
    BLOCKED = "blocked"
    LOOP = "loop"
    REFUSED = "refused"


class Say(msgspec.Struct, frozen=True):
    """Send this at the port."""

    port: int
    message: Bridge | Mesh


class SayToClients(msgspec.Struct, frozen=True):
    """Send this to all clients."""

    message: Bridge


class Probe(msgspec.Struct, frozen=True):
    """Send a probe at the port: something that any gateway passes on."""

    port: int


class Changed(msgspec.Struct, frozen=True):
    """A port is in another state, or has another place in the tree."""

    port: int


Action = Say | SayToClients | Probe | Changed


class Neighbour(msgspec.Struct):
    """Another port on the same network; instants in monotonic ns."""

    heard_at: int
    count: int
    agreement: int
    acked_at: int


def is_late(count: int, last: int) -> bool:
    """Whether a message was overtaken by one with the number `last`."""
    return (count - last) & 0xFFFF >= 0x8000


def acknowledged(acks: bytes, sender: int, sent: deque[tuple[int, int]]) -> int:
    """When `sender` sent what these acks name; 0: nothing of its that still counts. `sent`: count, instant."""
    for name, count in ACK.iter_unpack(acks):
        if name == sender:
            return next((at for each, at in reversed(sent) if each == count), 0)
    return 0


def packed_acks(acks: list[tuple[int, int]], each: int) -> list[bytes]:
    """Senders and counts, `each` of them in a message."""
    starts = range(0, max(len(acks), 1), each)
    return [b"".join(ACK.pack(*ack) for ack in acks[at : at + each]).ljust(each * ACK.size, b"\0") for at in starts]


class TreePort(msgspec.Struct, eq=False):
    """A port of this gateway.

    `until`: data may pass before this instant (monotonic ns). `in_tree`: whether it does, has done, or will soon do so;
    what others want is known by that. `gateways` are those heard on its network. `echoes`: it gives back what we say.
    `heeded_since`: since when all `leaves` there know our root. `private`: a connection whose other end stays the same
    while it is up, so that no gateway can come unheard, and no lease is needed while there is none. `resumes`: it was
    alone, and listens anew only because this program stood still. `flaps`: how many neighbours have gone, `flapped_at`
    when that was counted. `lost` counts what other gateways said in vain, by reason.
    """

    number: int
    opened_at: int
    until: int = 0
    state: PortState = PortState.LISTENING
    in_tree: bool = False
    neighbours: dict[Place, Neighbour] = {}
    leaves: dict[Place, Neighbour] = {}
    heeded_since: int | None = 0
    probes: dict[Place, tuple[int, int]] = {}
    view: object = None
    agreement: int = 0
    agreed_since: int | None = None
    said_at: int = -FOR_EVER
    say_at: int = 0
    probe_at: int = 0
    echoes: bool = False
    private: bool = False
    resumes: bool = False
    flaps: int = 0
    flapped_at: int = 0
    lost: Counter[str] = msgspec.field(default_factory=Counter)

    @property
    def gateways(self) -> set[int]:
        return {gateway for gateway, _ in self.neighbours}


def hear_leaf(port: TreePort, now: int, message: Leaf, gateway: int, acked_at: int, rooted_at: int) -> bool:
    """Enter what a module with several links says at a port; it counts from when it knows our root, and has an answer
    at once. `acked_at`: when what it acknowledges was sent; `rooted_at`: since when the root is what it is. False: it
    changes nothing.
    """
    place = (message.module, message.port)
    leaf = port.leaves.get(place)
    if leaf is None:
        port.say_at = min(port.say_at, max(now, port.said_at + APART))
        if not acked_at or acked_at < rooted_at or len(port.leaves) >= LEAVES:
            return False
        port.leaves = port.leaves | {place: Neighbour(now, message.count, 0, acked_at)}
    elif is_late(message.count, leaf.count):
        return False
    elif not _hears(message, gateway):
        port.leaves = {each: known for each, known in port.leaves.items() if each != place}
    else:
        leaf.heard_at, leaf.count, leaf.acked_at = now, message.count, max(leaf.acked_at, acked_at)
    return True


def bury_leaves(port: TreePort, now: int) -> None:
    """Forget the modules that have been silent."""
    if any(now - each.heard_at >= DEAD for each in port.leaves.values()):
        port.leaves = {place: each for place, each in port.leaves.items() if now - each.heard_at < DEAD}


def put_off_leaves(port: TreePort, now: int) -> None:
    """Believe in them for longer: what they said while this program stood still is yet to be read."""
    for leaf in port.leaves.values():
        leaf.heard_at = now


def see_heeded(port: TreePort, now: int, rooted_at: int) -> None:
    """See whether all modules there know our root by now."""
    if port.heeded_since is None and all(each.acked_at >= rooted_at for each in port.leaves.values()):
        port.heeded_since = now


def _hears(message: Leaf, gateway: int) -> bool:
    """Whether it may hear the gateway: who does not has no consent of it any more."""
    names = [name for name, _ in ACK.iter_unpack(message.acks)]
    return gateway in names or 0 not in names
