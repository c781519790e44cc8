"""The study of tiltOne on short runs: what must be so whatever the seed; and real links, in real time, only work."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import re
from functools import cache
from statistics import mean
from typing import TYPE_CHECKING, Any

import pytest

import r2p
from benchmarks import tiltone_study
from benchmarks.tiltone import delays
from benchmarks.tiltone.runs import STREAMS, TIMING, Outcome, Scenario, one
from r2p.codecs import rtcan
from r2p.sim.robots.tiltone import nodes
from r2p.sim.robots.tiltone.robot import MOTORS, ControlInput, TiltOne
from r2p.transports.memory import MemoryNetwork

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

LATENCY = 2 * (4 + 3)
"""Us: the longest of both ends of a frame, as the bus of the study has them."""
SLOT = TIMING.slot / 1000
PERIOD = 1e6 * nodes.PERIOD


@cache
def outcome(**changes: Any) -> Outcome:
    return one(Scenario(**{"after": 2.0, "duration": 0.3, **changes}))


def test_an_input_in_slots_is_never_older_than_two_periods_and_a_slot_and_others_are() -> None:
    """A slot takes the newest tilt, at most a period old, and its effort is in force until the next one, a period."""
    bound = 2 * PERIOD + SLOT + LATENCY
    loaded = outcome(load=0.9)
    assert loaded.load > 0.85
    assert max(loaded.ages) <= bound
    late = outcome(load=0.9, traffic="nrt")
    assert late.load > 0.85
    assert max(late.ages) > bound


def test_the_same_seed_gives_the_same_outcome_and_another_one_does_not() -> None:
    first, again, other = (
        one(Scenario(plant="torque", network="zenoh busy", traffic="nrt", after=1.5, duration=0.3, seed=seed))
        for seed in (1, 1, 2)
    )
    assert first == again
    assert first != other


def test_a_delay_of_the_network_makes_the_input_older_by_as_much() -> None:
    direct, delayed = (outcome(network="memory", traffic="nrt", delay=delay) for delay in (0.0, 0.01))
    assert mean(delayed.ages) - mean(direct.ages) == pytest.approx(10_000)


def test_sizes_of_the_other_modules_messages_are_right() -> None:
    assert [len(stream.message.encode()) for stream in STREAMS] == [stream.size for stream in STREAMS]
    assert [stream.slots for stream in STREAMS] == [rtcan.fragment_count(stream.size) for stream in STREAMS]


@pytest.mark.parametrize("transport", delays.LISTEN)
@pytest.mark.parametrize("state", tiltone_study.STATES)
def test_a_recording_has_what_it_says(transport: str, state: str) -> None:
    recordings = delays.load(transport)
    recording = recordings.of(state)
    arrived = [delay for delay in recording.delays if delay is not None]
    assert recordings.transport == transport
    assert recordings.period == delays.PERIOD == nodes.PERIOD
    assert len(recording.delays) == delays.COUNT
    assert 0 < min(arrived) <= max(arrived) < 1e6


@pytest.mark.virtual_time
async def test_a_recording_is_replayed_as_it_is_from_a_random_point() -> None:
    recording = delays.Recording(0.0, [100, None, 300, 400])
    network, seen = MemoryNetwork(), []
    replaying = asyncio.create_task(delays.replay(recording, 0.01, network, random.Random(1)))
    await asyncio.sleep(0.005)
    for _ in range(8):
        seen.append(None if network.loss else round(network.delay * 1e6))
        await asyncio.sleep(0.01)
    replaying.cancel()
    start = recording.delays.index(seen[0])
    assert seen == 2 * (recording.delays[start:] + recording.delays[:start])


def test_the_command_prints_a_row_for_each_network_and_delay(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(tiltone_study, "PLANTS", {"geared": nodes.GEARED})
    monkeypatch.setattr(tiltone_study, "CONSTANT", (0,))
    monkeypatch.setattr(tiltone_study.Study, "rows", rows)
    tiltone_study.main(["--loads", "0", "90"])
    text = capsys.readouterr().out
    assert re.findall(r"^\| ([^|]+?) \|", text, re.MULTILINE) == [
        "network", "---", "none: no delay", "HRT, 0%", "HRT, 90%", "SRT, 0%", "SRT, 90%", "NRT, 0%", "NRT, 90%",
        "zenoh, quiet", "zenoh, busy", "tcp, quiet", "tcp, busy",
        "delay ms", "---:", "0",
    ]  # fmt: skip


def rows(_study: tiltone_study.Study, scenarios: list[Scenario]) -> list[tiltone_study.Row]:
    """Instead of runs: one outcome for all."""
    return [tiltone_study.Row(scenario, [Outcome(0.02, 0.6, [2000, 4000], 0.9)]) for scenario in scenarios]


@contextlib.asynccontextmanager
async def real_links(transport: str) -> AsyncIterator[str]:
    """A module that all modules are linked to which open this URL, and which forwards their messages."""
    listen = delays.LISTEN[transport].replace("network=delays", f"network=t{os.getpid()}")
    async with r2p.Module("HUB", via=listen, bridge=True, watchdog=False) as hub:
        ((_, address),) = hub.addresses
        port = int(address.rpartition(":")[2])
        yield delays.CONNECT[transport].format(port).replace("network=delays", f"network=t{os.getpid()}")


async def stand(transport: str) -> list[ControlInput]:
    """Let it balance until a hundred efforts have arrived at its motors."""
    enough = asyncio.Event()
    arrived: list[ControlInput] = []

    def note(each: ControlInput) -> None:
        if not robot.hardware.body.held:
            arrived.append(each)
            if len(arrived) >= 100:
                enough.set()

    async with real_links(transport) as via:
        robot = TiltOne(via, seed=1, traffic="nrt", on_input=note)
        async with robot:
            await robot.ready()
            await robot.release()
            await enough.wait()
            assert not robot.hardware.body.fallen
    return arrived


@pytest.mark.parametrize("transport", delays.LISTEN)
def test_it_stays_up_over_a_real_link_in_real_time(transport: str) -> None:
    arrived = asyncio.run(asyncio.wait_for(stand(transport), 300))
    assert {each.wheel for each in arrived} == set(range(len(MOTORS)))
