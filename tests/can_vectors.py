"""Typed access to `tests/golden/rtcan.json`: what the original RTCAN code did over a mock controller.

@pytest.mark.golden
@pytest.mark.parametrize("case", can_cases("rx"), ids=str)
def test_replay(case: CanCase) -> None: ...
"""

from __future__ import annotations

from functools import cache
from typing import Any

import msgspec

from r2p.codecs.can_bits import Frame
from tests.vectors import GOLDEN


class Step(msgspec.Struct, frozen=True):
    """One command of the recording: its verb and its words; the file says what they mean."""

    verb: str
    words: tuple[str, ...]


class Sent(msgspec.Struct, frozen=True):
    """A frame that went out: because of step `step`, at `t` ms, in this cycle and slot."""

    step: int
    frame: Frame
    t: int
    cycle: int
    slot: int


class Event(msgspec.Struct, frozen=True):
    """What else happened in step `step`. `fields` as in the file, without step and type."""

    step: int
    type: str
    fields: dict[str, Any]


class CanCase(msgspec.Struct, frozen=True):
    """One recording. `hrt` says whether this build of the firmware had slots; `master`, whether it sent sync frames."""

    name: str
    group: str
    comment: str
    hrt: bool
    master: bool
    steps: tuple[Step, ...]
    sent: tuple[Sent, ...]
    events: tuple[Event, ...]

    def __str__(self) -> str:
        return self.name

    def of(self, type: str) -> list[Event]:
        """The events of one type: tx, tx_callback, rx_callback, filter, state, calendar, driver, time, timer, ..."""
        return [event for event in self.events if event.type == type]


def payload(word: str) -> bytes:
    """The bytes of a step's word; `-` stands for none."""
    return b"" if word == "-" else bytes.fromhex(word)


def arriving(step: Step) -> Frame:
    """The frame of a step `frame ID HEX`."""
    assert step.verb == "frame"
    return Frame(int(step.words[0], 16), payload(step.words[1]) if len(step.words) > 1 else b"")


def can_cases(*groups: str) -> list[CanCase]:
    """All recordings, or those of these groups.

    srt, srt-laxity, srt-size, srt-queue, rx are of builds without HRT; hrt-master, hrt-frame, hrt-srt, hrt-time of
    masters; hrt-slave of slaves.
    """
    return [case for case in _recorded() if not groups or case.group in groups]


@cache
def _recorded() -> tuple[CanCase, ...]:
    raw = msgspec.json.decode((GOLDEN / "rtcan.json").read_bytes())
    return tuple(_case(case) for case in raw["cases"])


def _case(raw: dict[str, Any]) -> CanCase:
    build = raw["build"]
    return CanCase(
        name=raw["name"],
        group=raw["group"],
        comment=raw.get("comment", ""),
        hrt="HRT=1" in build,
        master="master" in build,
        steps=tuple(_step(text) for text in raw["inputs"]["steps"]),
        sent=tuple(_sent(frame) for frame in raw["frames"]),
        events=tuple(_event(event) for event in raw["events"]),
    )


def _step(text: str) -> Step:
    verb, *words = text.split()
    return Step(verb, tuple(words))


def _sent(raw: dict[str, Any]) -> Sent:
    frame = Frame(int(raw["id"], 16), payload(raw["data"]))
    return Sent(raw["step"], frame, raw["t"], raw["cycle"], raw["slot"])


def _event(raw: dict[str, Any]) -> Event:
    return Event(raw["step"], raw["type"], {key: value for key, value in raw.items() if key not in {"step", "type"}})
