"""A hostile peer that speaks the protocol well: nothing that it says raises, and nothing that is kept of it grows."""

from __future__ import annotations

import asyncio
import random
from collections import deque
from typing import Any, get_args

import msgspec
import pytest

import r2p
from r2p.codecs import management as m
from r2p.errors import MessageError
from r2p.msg import Led, Text
from r2p.names import module_alias
from r2p.protocols.discovery import aliases, directory, negotiation
from r2p.runtime.topic import Topic, TopicSpace
from r2p.testing.network import node_in
from tests.transports.conversation import Script, line, manage

KINDS: tuple[type[msgspec.Struct], ...] = get_args(m.Management)
MOST = 64
"""What takes the place of the bound of 4096, so that fewer messages reach it."""
KNOWN = {
    "module": ["PC1", "IMU1"],
    "gateway": ["GW1"],
    "node": ["test"],
    "topic": ["leds", "text", "R2P", "R2P_PC1", "R2P_IMU1"],
    "alias": ["PC1", module_alias("robot1/MOTOR1")],
    "piece": ["robot1/", "MOTOR1", "robot1/MOTOR1"],
    "release": ["", "0.1.0"],
}
LENGTHS = {"module": 7, "gateway": 7, "node": 8, "topic": 16, "alias": 7, "piece": 22, "release": 14}
LETTERS = "abcdefghijklmnopqrstuvwxyzABC0123456789_"


def anything(chance: random.Random, kind: type[msgspec.Struct]) -> bytes:
    """A message of this kind, with a name that is known here or a new one, and numbers of any size."""
    while True:
        values = {field.name: _value(chance, field.name, field.type) for field in msgspec.structs.fields(kind)}
        if kind in (m.Stop, m.Reboot) and values["module"] == "PC1":
            continue  # that would be obeyed
        try:
            return m.encode(kind(**values))
        except MessageError:
            continue  # a number or a text that does not fit


def a_long_name(chance: random.Random) -> m.LongName:
    """A piece of a name that is valid, of 400 topics and nodes, some with chosen aliases."""
    name = f"{chance.choice(['', 'leds=', 'other='])}long_names/of_topics/{chance.randint(0, 200)}"
    kind = chance.choice([m.KIND_TOPIC, m.KIND_NODE])
    return chance.choice(m.long_name_messages(kind, name if kind == m.KIND_TOPIC else name.replace("/", "_")))


def _value(chance: random.Random, name: str, kind: object) -> Any:
    if kind is str:
        if chance.random() < 0.3:
            return chance.choice(KNOWN[name])
        return "".join(chance.choices(LETTERS, k=chance.randint(0, LENGTHS[name])))
    if kind is bytes:
        sizes = {"params": 10, "fingerprint": 8, "highs": 24, "acks": chance.choice([12, 18]), "nonce": 16, "tag": 16}
        size = sizes.get(name, 18)
        return chance.choice([bytes(size), chance.randbytes(size)])
    return chance.getrandbits(chance.choice([0, 1, 2, 3, 8, 16, 32, 64]))


def grown(root: object) -> dict[str, int]:
    """The containers that `root` keeps, with far more entries than MOST, by where they are."""
    found: dict[str, int] = {}
    seen: set[int] = set()
    waiting: deque[tuple[str, Any]] = deque([(type(root).__name__, root)])
    while waiting:
        where, each = waiting.popleft()
        if id(each) in seen or isinstance(
            each, asyncio.AbstractEventLoop | r2p.Module | TopicSpace | Topic | str | bytes
        ):
            continue
        seen.add(id(each))
        if isinstance(each, dict | list | set | frozenset | deque | tuple | bytearray):
            if len(each) > 2 * MOST and getattr(each, "maxlen", None) is None:
                found[where] = len(each)
            parts = [*each.keys(), *each.values()] if isinstance(each, dict) else list(each)
            waiting += [(f"{where}[]", part) for part in parts]
        elif type(each).__module__.startswith("r2p."):
            names = {*getattr(each, "__dict__", ()), *(slot for base in type(each).__mro__ for slot in _slots(base))}
            waiting += [(f"{where}.{name}", getattr(each, name, None)) for name in names]
    return found


def _slots(base: type) -> tuple[str, ...]:
    slots = getattr(base, "__slots__", ())
    return (slots,) if isinstance(slots, str) else tuple(slots)


@pytest.mark.virtual_time
@pytest.mark.parametrize("seed", range(4))
async def test_nothing_grows_whatever_a_peer_says(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(directory, "TABLE_MAX", MOST)
    monkeypatch.setattr(aliases, "NAMES_MAX", MOST)
    monkeypatch.setattr(aliases, "_UNFINISHED_MAX", MOST)
    monkeypatch.setattr(aliases, "_RIVALS_MAX", MOST)
    monkeypatch.setattr(negotiation, "PEERS_MAX", MOST)
    chance = random.Random(seed)
    script = Script()
    errors: list[Any] = []
    asyncio.get_running_loop().set_exception_handler(lambda _loop, context: errors.append(context))
    async with r2p.Module("PC1", via=script) as module, node_in(module) as node:
        node.advertise("leds", Led, r2p.Periodic(0.1, Led), latch=True)
        text = node.advertise("text", Text)
        heard = [node.subscribe(topic, None, lossy=True) for topic in ("leds", "text")]
        for _ in range(60):
            for _ in range(50):
                script.hear(manage_bytes(anything(chance, chance.choice(KINDS))))
                script.hear(manage_bytes(m.encode(a_long_name(chance))))
                script.hear(line(chance.choice(["leds", "text", "other"]), chance.randbytes(chance.randint(1, 64))))
            text.publish_nowait(Text())
            await asyncio.sleep(chance.choice([0.0, 0.01, 1.0]))
            script.said.clear()
        assert not errors
        assert node.name in module.nodes
        assert grown(script.link) == {}
        assert len(module.space.topics) <= MOST
        assert any(subscriber.queue for subscriber in heard)
        await asyncio.sleep(100)  # and all that it said is forgotten
        script.said.clear()
        script.hear(manage(m.Hello("IMU9", 99)) + manage(m.SubscribeRequest("text", 64, 1)))
        await asyncio.sleep(1)
        await text.publish(Text(text="still here"))
        await asyncio.sleep(0)
        assert script.topics("text")


def manage_bytes(data: bytes) -> bytes:
    """A debug line on the management topic."""
    return line("R2P", data)
