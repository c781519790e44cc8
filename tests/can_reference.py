"""CAN written down bit by bit, slowly, as specified: what the codec and the simulated bus are compared with."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from r2p.codecs.can_bits import AnyFrame

INTERMISSION = 3


def crc15(bits: str) -> str:
    """The CRC as the specification of CAN writes it: a shift register, a bit at a time."""
    register = 0
    for bit in bits:
        crc_next = int(bit) ^ register >> 14
        register = register << 1 & 0x7FFF
        if crc_next:
            register ^= 0x4599
    return format(register, "015b")


def stuffed(bits: str) -> str:
    sent = ""
    for bit in bits:
        sent += bit
        if sent[-5:] in {"00000", "11111"}:
            sent += "1" if bit == "0" else "0"
    return sent


def on_the_bus(
    identifier: int,
    data: bytes,
    *,
    extended: bool = True,
    acknowledged: bool = True,
    remote: int | None = None,
    code: int | None = None,
) -> str:
    """All bits of a frame, start of frame to end of frame.

    `remote`: of a remote frame, the length that it asks for; `code`: the length code, if it is not the size of the
    data.
    """
    rtr, length = ("0", len(data) if code is None else code) if remote is None else ("1", remote)
    if extended:
        id_bits = f"{identifier:029b}"
        head = "0" + id_bits[:11] + "11" + id_bits[11:] + rtr + "00"
    else:
        head = "0" + f"{identifier:011b}" + rtr + "0" + "0"
    bits = head + f"{length:04b}" + "".join(f"{byte:08b}" for byte in data)
    return stuffed(bits + crc15(bits)) + "1" + ("01" if acknowledged else "11") + "1111111"


def wire(frame: AnyFrame, *, acknowledged: bool = True) -> str:
    """All bits of a frame of any kind."""
    return on_the_bus(
        frame.id,
        frame.data,
        extended=frame.extended,
        acknowledged=acknowledged,
        remote=frame.remote,
        code=frame.length_code,
    )


@dataclass
class Node:
    """A controller with any number of mailboxes: `requests` are (from which bit on, frame)."""

    requests: list[tuple[int, AnyFrame]]
    one_shot: bool = False
    sending: AnyFrame | None = None


@dataclass
class Trace:
    """In bits: (start, end, frame, sender), and (bit after the one that was lost, frame, loser)."""

    frames: list[tuple[int, int, AnyFrame, int]] = field(default_factory=list)
    losses: list[tuple[int, AnyFrame, int]] = field(default_factory=list)


def simulate(nodes: list[Node]) -> Trace:
    """Run a bus with two nodes or more, bit by bit, until all is sent or lost.

    No two frames may be of one identifier and kind.
    """
    trace = Trace()
    now = 0
    while any(node.requests for node in nodes):
        for node in nodes:
            ready = [frame for at, frame in node.requests if at <= now]
            node.sending = min(ready, key=wire) if ready else None  # dominant bits first: what would win
        senders = [node for node in nodes if node.sending]
        now = _frame(now, nodes, senders, trace) if senders else now + 1
    return trace


def _frame(start: int, nodes: list[Node], senders: list[Node], trace: Trace) -> int:
    """One arbitration and its frame; returns when the bus is free again."""
    now = start
    wires = {id(node): wire(node.sending) for node in senders if node.sending}
    while now - start < len(wires[id(senders[0])]):
        levels = {id(node): wires[id(node)][now - start] for node in senders}
        bus = min(levels.values())  # wired AND: dominant wins
        now += 1
        for node in [node for node in senders if levels[id(node)] != bus]:
            senders.remove(node)
            assert node.sending is not None
            trace.losses.append((now, node.sending, nodes.index(node)))
            if node.one_shot:
                _drop(node)
    (winner,) = senders
    assert winner.sending is not None
    trace.frames.append((start, now, winner.sending, nodes.index(winner)))
    _drop(winner)
    return now + INTERMISSION


def _drop(node: Node) -> None:
    node.requests = [(at, frame) for at, frame in node.requests if frame is not node.sending]
