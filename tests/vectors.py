"""Typed access to `tests/golden`: what was recorded from the original firmware.

@pytest.mark.golden
@pytest.mark.parametrize("case", cases("pubsub", build="plain"), ids=str)
def test_replay(case: Case) -> None: ...
"""

from functools import cache
from pathlib import Path
from typing import Any

import msgspec

GOLDEN = Path(__file__).parent / "golden"
FROM_NODE = "node->peer"
TO_NODE = "peer->node"


class Entry(msgspec.Struct, frozen=True):
    """What went over the wire at one moment.

    `dir` is FROM_NODE or TO_NODE on the debug line (`data`: the bytes, line ends included), `X->can` on the bus
    (`data`: the frame's payload, `can_id` its 29-bit identifier), or "note" (`comment` says what happened). `decoded`
    is the recorder's view of a line, or of the message that a frame completes; empty if it had none. `node` is the
    module that the line belongs to where there are several.
    """

    t_ms: int
    dir: str
    data: bytes
    decoded: dict[str, Any]
    comment: str
    can_id: int | None
    node: str


class Case(msgspec.Struct, frozen=True):
    """One session. `name` alone is not unique: the same session was recorded with several builds of the firmware."""

    name: str
    build: str
    group: str
    description: str
    env: dict[str, str]
    nodes: dict[str, Any]
    node_log: dict[str, list[str]]  # by module; by "" where there is only one
    transcript: tuple[Entry, ...]

    def __str__(self) -> str:
        return f"{self.name}-{self.build.replace('/', '_')}"

    def stream(self, direction: str = FROM_NODE) -> bytes:
        """All bytes that went this way, without their times."""
        return b"".join(entry.data for entry in self.transcript if entry.dir == direction)


def cases(group: str | None = None, build: str | None = None, name: str | None = None) -> list[Case]:
    """The recorded sessions, all of them or those of one group (pubsub, bootloader, gateway-rtcan), build, name."""
    wanted = {"group": group, "build": build, "name": name}
    return [
        case for case in _read("debug") if all(value in (None, getattr(case, key)) for key, value in wanted.items())
    ]


def loader_cases() -> list[Case]:
    """The recorded sessions with the loader, whose other end were r2p's own codecs."""
    return list(_read("loader"))


@cache
def _read(name: str) -> tuple[Case, ...]:
    recorded = msgspec.json.decode((GOLDEN / f"{name}.json").read_bytes())
    return tuple(_case(case) for case in recorded["cases"])


def _case(raw: dict[str, Any]) -> Case:
    log = raw["node_log"]
    return Case(
        name=raw["name"],
        build=raw["build"],
        group=raw["group"],
        description=raw["description"],
        env=raw.get("env", {}),
        nodes=raw.get("nodes", {}),
        node_log={"": log} if isinstance(log, list) else log,
        transcript=tuple(_entry(entry) for entry in raw["transcript"]),
    )


def _entry(raw: dict[str, Any]) -> Entry:
    can_id = raw.get("can_id")
    return Entry(
        t_ms=raw["t_ms"],
        dir=raw["dir"],
        data=bytes.fromhex(raw.get("hex", raw.get("data", ""))),
        decoded=raw.get("decoded", raw.get("message", {})),
        comment=raw.get("comment", ""),
        can_id=None if can_id is None else int(can_id, 16),
        node=raw.get("node", ""),
    )
