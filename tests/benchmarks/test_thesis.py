"""The thesis's benchmark (section 4.4) on short runs: what it must show whatever the seed."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from functools import cache
from itertools import pairwise
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks import rtcan_thesis
from benchmarks.thesis import schedulers, tables
from benchmarks.thesis.network import HRT, NODES, SRT, TIMING, Node, Outcome, Scenario, simulated
from benchmarks.thesis.summary import summarise
from r2p.codecs import rtcan
from r2p.sim import run
from r2p.sim.transport import SimCan

if TYPE_CHECKING:
    from r2p.sim.can import FrameRecord

JITTER = 3_000  # ns
BOUND = 3 * JITTER  # master's transmission, slave's reception, slave's transmission
ROUNDING = 10  # ns: four instants in whole ns, by two clocks

LOADS = (0.0, 0.95, 1.3)


@cache
def outcome(**changes: Any) -> Outcome:
    return simulated(Scenario(**{"duration": 0.5, **changes}))


def drift(scenario: Scenario) -> float:
    """How far two clocks part from one sync to the end of the slot after its cycle, in ns."""
    return 2 * scenario.ppm * 1e-6 * (TIMING.cycle + TIMING.slot)


@pytest.mark.parametrize("load", LOADS)
def test_hard_real_time_never_misses_and_its_periods_are_exact(load: float) -> None:
    result = outcome(load=load)
    assert result.strays == 0
    for (_, name), track in result.hrt.items():
        (period,) = (each.period for each in HRT if each.name == name)
        assert track.missed(result.scenario) == 0
        assert {after - before for before, after in pairwise(track.slots)} == {period}
        assert len(track.slots) == pytest.approx(result.scenario.duration * 1e9 / (period * TIMING.slot), abs=1.5)


def test_the_periods_are_those_of_the_thesis() -> None:
    result = outcome(load=0.95, jitter=0, ppm=0.0)
    exact = {"A": 996_000, "B": 4_980_000, "C": 9_960_000}
    for (_, name), track in result.hrt.items():
        assert set(track.periods) == {exact[name]}
        assert set(track.errors) == {0}


@pytest.mark.parametrize("load", LOADS)
def test_starts_of_frames_are_as_exact_as_latencies_and_clocks(load: float) -> None:
    result = outcome(load=load)
    bound = BOUND + drift(result.scenario) + ROUNDING
    for (node, _), track in result.hrt.items():
        mine = JITTER + ROUNDING if node == NODES[0] else bound
        assert max(abs(error) for error in track.errors) <= mine
        nominal = track.message.period * TIMING.slot
        slow = nominal * result.scenario.ppm * 1e-6
        assert max(abs(period - nominal) for period in track.periods) <= 2 * mine + slow
    assert max(abs(error) for track in result.hrt.values() for error in track.errors) > 1.5 * JITTER


def test_the_load_does_not_move_hard_real_time() -> None:
    """Without jitter the very instants are the same, whatever events there are."""
    idle, *loaded = (outcome(load=load, jitter=0) for load in LOADS)
    for other in loaded:
        assert {key: track.starts for key, track in other.hrt.items()} == {
            key: track.starts for key, track in idle.hrt.items()
        }
    worst = max(abs(error) for track in idle.hrt.values() for error in track.errors)
    assert 0 < worst <= drift(idle.scenario) + ROUNDING


def test_events_with_more_time_wait_longer() -> None:
    events = outcome(load=0.95, duration=2.0).srt
    a, b, c = (mean(events[name].latencies) for name in "ABC")
    assert a < b < c
    assert all(each.count > 200 for each in events.values())


def test_events_are_lost_only_to_their_deadlines() -> None:
    few, many = outcome(load=0.6).srt, outcome(load=1.3).srt
    assert [each.missed for each in few.values()] == [0, 0, 0]
    assert all(each.missed > each.count // 10 for each in many.values())
    late = outcome(load=1.3, drop=False).srt
    for kind in SRT:  # one frame may end after the deadline before which it began: dropped is only what has not
        assert max(many[kind.name].latencies) < kind.deadline + 20_000_000
        assert max(late[kind.name].latencies) > 2 * kind.deadline


def test_events_that_are_never_dropped_cost_no_slots() -> None:
    """Longer than a lease: management gets through between more overdue events than the bus can carry."""
    result = outcome(load=1.3, drop=False, duration=4.0, seed=3)
    assert sum(track.missed(result.scenario) for track in result.hrt.values()) == result.strays == 0


@pytest.mark.parametrize("jitter", [0, JITTER])
def test_the_throughput_of_the_thesis(jitter: int) -> None:
    result = outcome(load=2.0, hrt=False, kinds=SRT[:1], jitter=jitter)
    assert result.payload / result.scenario.duration == pytest.approx(tables.THROUGHPUT, rel=0.01)


def test_one_seed_one_course_of_events() -> None:
    """Also in another process, where the hashes of strings are others."""
    code = (
        "import hashlib; from benchmarks.thesis.network import Scenario, simulated;"
        "print(hashlib.sha256(repr(simulated(Scenario(duration=0.1, load=1.3, seed={}))).encode()).hexdigest())"
    )
    digests = [
        subprocess.run(
            [sys.executable, "-c", code.format(seed)],
            env={"PYTHONHASHSEED": hashes},
            cwd=Path(__file__).parents[2],
            check=True,
            capture_output=True,
        ).stdout
        for seed, hashes in ((1, "1"), (1, "2"), (2, "1"))
    ]
    assert digests[0] == digests[1] != digests[2]


Wish = tuple[int, int, tuple[int, int] | None]
"""A node's number, a topic, and what it is to have: bytes, every so many slots; None: nothing any more."""

wishes = st.lists(
    st.tuples(
        st.integers(0, len(NODES) - 1),
        st.integers(2, 6),
        st.none() | st.tuples(st.integers(1, 24), st.sampled_from([2, 3, 4, 6, 10, 12, 20, 30, 60, 120, 180])),
    ),
    min_size=4,
    max_size=16,
)


def frames(wishes: list[Wish], seed: int) -> list[FrameRecord]:
    """What is on the bus, with jitter and drift, while this is asked for."""

    async def main() -> list[FrameRecord]:
        failures: list[object] = []
        asyncio.get_running_loop().set_exception_handler(lambda _, context: failures.append(context))
        shared = SimCan(seed=seed)
        nodes = [Node(name, shared, Scenario(seed=seed)) for name in NODES]
        records: list[FrameRecord] = []
        async with asyncio.TaskGroup() as group:
            running = []
            for node in nodes:
                running.append(group.create_task(node.run()))
                await asyncio.sleep(0.1)
            await asyncio.sleep(2)
            shared.bus.observers.append(records.append)
            for number, high, wish in wishes:
                node = nodes[number]
                if wish is None:
                    node.driver.carry_out(node.engine.release(node.driver.now(), high))
                else:
                    node.reserve(high, *wish)
                await asyncio.sleep(0.05)
            for task in running:
                task.cancel()
        assert not failures
        return records

    return run(main)


@settings(max_examples=6)
@given(wishes, st.integers(1, 1000))
def test_no_slot_ever_holds_two_frames(wishes: list[Wish], seed: int) -> None:
    """Whatever is asked for, granted or refused, and given back."""
    records = frames(wishes, seed)
    starts = [each.start for each in records if each.frame.id >> 23 == rtcan.HRT]
    assert all(each.error is None and len(each.senders) == 1 for each in records)
    assert all(after - before > TIMING.slot - 2 * BOUND - 2_000 for before, after in pairwise(starts))


def test_slots_that_are_given_back_go_to_others() -> None:
    nothing: Wish = (1, 2, None)
    asked: list[Wish] = [(1, 2, (16, 3)), (2, 3, (8, 6)), (0, 4, (8, 6)), nothing, (0, 5, (8, 6)), nothing, nothing]
    highs = {each.frame.id >> 15 & 0xFF for each in frames(asked, 1) if each.frame.id >> 23 == rtcan.HRT}
    assert highs == {rtcan.SYNC, 2, 3, 5}  # 4 came too early: all was taken


def test_least_laxity_meets_what_fixed_priorities_miss() -> None:
    """Figure 4.11."""
    fixed, laxity = schedulers.scheduled(schedulers.fixed), schedulers.scheduled(schedulers.least_laxity)
    assert [(each.source, each.missed) for each in fixed] == [*((s, False) for s in "BACAB"), ("C", True)]
    assert [(each.source, each.missed) for each in laxity] == [(source, False) for source in "BACACB"]


def test_summaries_add_up() -> None:
    one, other = (summarise(outcome(load=0.95, seed=seed)) for seed in (1, 2))
    both = summarise(outcome(load=0.95, seed=1))
    both.merge(other)
    a = both.kinds["A"]
    assert a.count == one.kinds["A"].count + other.kinds["A"].count
    assert a.latency.mean == pytest.approx(
        mean(outcome(load=0.95, seed=1).srt["A"].latencies + outcome(load=0.95, seed=2).srt["A"].latencies)
    )
    assert sum(a.latency.bins.values()) == a.latency.count
    assert both.periods["C"].least == min(one.periods["C"].least, other.periods["C"].least)
    assert (both.seeds, both.simulated, both.hrt_missed) == (2, 1.0, 0)


def test_the_report_and_its_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rtcan_thesis.main(["--seeds", "1", "--duration", "0.2", "--loads", "95", "--figures", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "| H_A | 995.9 | 0.86 |" in printed
    assert "| S_B | 5.52%, 5.13 |" in printed
    names = {"figure-4-11.svg", "figure-4-12.svg", "figure-4-13.svg", "figure-4-14.svg", "misses.svg", "latencies.svg"}
    assert {each.name for each in tmp_path.iterdir()} == names
    assert all(each.read_text().startswith("<svg") and "nan" not in each.read_text() for each in tmp_path.iterdir())
