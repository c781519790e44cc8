"""The recorded conversations with our module in the place of the firmware's: it hears what the peer said, at the
recorded times and in chunks of every size, and answers, sends and calls back as the firmware did.

The group is `pubsub`; the others are a boot loader and a gateway, which a module on a PC is not. What is left out of
it, and why:

- queue_length 0 halts the firmware, and a firmware gateway answers also for topics that it only subscribes: their
  answers have nothing to be compared with.
- BOOTLOAD: we have no boot loader and refuse.
- `malformed_*`: answers that the firmware does not give any more because it has leaked all its buffers.
- A wrong checksum: the firmware takes the line, we don't.
- What waits while the peer is away: the firmware sends it late, we discard it.
"""

import asyncio
import re

import pytest

import r2p
from r2p.codecs import debug
from r2p.codecs import management as m
from r2p.msg import Led, Velocity3
from tests.protocols.discovery.test_recorded import NOT_LIKE_US, PubSub, gist, management, recorded_answers
from tests.transports.conversation import Script
from tests.vectors import FROM_NODE, TO_NODE, Case, Entry, cases

CHUNKS = (1, 2, 3, 7, 64, None)
LEFT_OUT = (*NOT_LIKE_US, "subscribe_leds_queue0", "bootload_own")
CASES = [case for case in cases("pubsub") if not str(case).startswith(LEFT_OUT)]
DEAF = "malformed_payload_leaks_pool-plain"
"""Here the firmware's callback misses good lines, too: each bad one has cost it a buffer."""

_CALLBACK = re.compile(r"CALLBACK cmd (.*)")
_SETTLED = 0.01  # seconds


class Board:
    """The two nodes of the recorded firmware; they start `start` seconds after their module."""

    def __init__(self, start: float) -> None:
        self.start = start
        self.commands: list[str] = []

    async def ledpub(self, node: r2p.Node) -> None:
        await asyncio.sleep(self.start)
        leds = node.advertise("leds", Led)
        value = 0
        async for _ in node.every(0.5):
            if leds.subscribers:
                await leds.publish(Led(led=2, value=value))
                value ^= 1

    async def velsub(self, node: r2p.Node) -> None:
        await asyncio.sleep(self.start)
        async for command in node.subscribe("cmd", Velocity3, queue=5):
            self.commands.append(as_logged(command))


@pytest.mark.golden
@pytest.mark.virtual_time
@pytest.mark.parametrize("chunk", CHUNKS)
@pytest.mark.parametrize("case", CASES, ids=str)
async def test_as_the_firmware(case: Case, chunk: int | None) -> None:
    script, board = Script(), Board(first_advertise(case) / 1000)
    async with r2p.Module("IMUGW" if case.build.startswith("bridge") else "IMU1", via=script) as module:
        module.start(board.ledpub)
        module.start(board.velsub)
        await replay(case, chunk, script)
        assert script.topics("leds") == recorded_leds(case)
        assert last_flags(script) == recorded_flags(case)
        logged = [match[1] for line in case.node_log[""] if (match := _CALLBACK.search(line))]
        good = good_commands(case)
        understood = [each for each in logged if each in good]
        if str(case).startswith(DEAF):
            assert board.commands[: len(understood)] == understood
            assert board.commands == good
        else:
            assert board.commands == understood


async def replay(case: Case, chunk: int | None, script: Script) -> None:
    """Say what the peer said; check the answers to each message."""
    loop = asyncio.get_running_loop()
    for at, entry in enumerate(case.transcript):
        await asyncio.sleep(entry.t_ms / 1000 + at * 1e-6 - loop.time())
        if entry.dir == TO_NODE:
            before = len(script.said)
            script.hear(entry.data, chunk)
            await asyncio.sleep(5e-7)
            if not case.name.startswith("malformed"):
                answers = [each.management for each in script.said[before:] if each.topic == "R2P"]
                assert about(answers, entry) == recorded_answers(case, at), f"at {entry.t_ms} ms"
        elif "disconnects" in entry.comment:
            script.link.disconnect("recorded")
        elif "connects again" in entry.comment:
            script.link.connect(script)
    await asyncio.sleep(_SETTLED)


def about(answers: list[m.Management], entry: Entry) -> list[tuple[str, str, int]]:
    """The answers of the firmware's kind, about the topics that were asked for."""
    topics = {each.topic for each in management(entry) if isinstance(each, PubSub)}
    return [each for each in gist(answers) if each[1] in topics]


def first_advertise(case: Case) -> int:
    """When the firmware's nodes started (ms)."""
    return next(
        entry.t_ms
        for entry in case.transcript
        if entry.dir == FROM_NODE and any(isinstance(each, m.Advertise) for each in management(entry))
    )


def recorded_leds(case: Case) -> list[bytes]:
    """What the firmware published, without what had waited for the peer to come back."""
    back = next((entry.t_ms for entry in case.transcript if "connects again" in entry.comment), -1)
    return [
        line.data
        for entry in case.transcript
        if entry.dir == FROM_NODE and not back <= entry.t_ms <= back + 1
        for line in debug.Reader().feed(entry.data)
        if line.topic == b"leds"
    ]


def good_commands(case: Case) -> list[str]:
    """What the peer published in lines without a fault."""
    lines = debug.Reader().feed(case.stream(TO_NODE))
    return [as_logged(Velocity3.decode(each.data)) for each in lines if each.topic == b"cmd" and len(each.data) == 12]


def as_logged(command: Velocity3) -> str:
    """As the firmware's callback prints it."""
    return f"x={command.x:.9g} y={command.y:.9g} w={command.w:.9g}"


def last_flags(script: Script) -> int:
    alive = [said.management for said in script.said if said.topic == "R2P" and said.data[-1] == 0x11]
    assert isinstance(alive[-1], m.Alive)
    return alive[-1].flags


def recorded_flags(case: Case) -> int:
    alive = [
        each
        for entry in case.transcript
        if entry.dir == FROM_NODE
        for each in management(entry)
        if isinstance(each, m.Alive)
    ]
    return alive[-1].flags
