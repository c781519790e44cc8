"""What each protocol must do whatever the seed, on short runs."""

from __future__ import annotations

import asyncio
import itertools
from typing import TYPE_CHECKING

import pytest

from benchmarks.protocols.cases import BABBLER, PROTOCOLS, StudyCase, add_message, simulate
from benchmarks.protocols.ftt_can import GUARD, TRIGGER, FttCan
from benchmarks.protocols.message_sets import named_set, random_set
from benchmarks.protocols.network import ProtocolSetup
from benchmarks.protocols.ttcan import SoftwareTtcan, Ttcan
from benchmarks.protocols.ttcan_matrix import CYCLES
from r2p.codecs.can_bits import OtherFrame, wire_identifier
from r2p.sim import run

if TYPE_CHECKING:
    from r2p.sim.can import FrameRecord

SHORT = 0.06  # s


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_quiet_network_misses_nothing_and_the_same_seed_gives_the_same_figures(protocol: str) -> None:
    case = StudyCase(protocol=protocol, messages="table-4.1", duration=SHORT)
    figures = simulate(case)
    assert figures == simulate(case)
    assert figures.periodic > 100
    assert not figures.periodic_missed
    assert not figures.sporadic_missed
    assert figures.busy > 0.1


def test_slots_are_steadier_than_windows_and_windows_than_nothing() -> None:
    """Bounds that follow from the latencies (4 us, 3 us either way), bits of 1 us, and frames of 135 us."""
    jitter = {
        protocol: simulate(StudyCase(protocol=protocol, messages="table-4.1", duration=SHORT)).jitter_fast
        for protocol in ("TTCAN", "TTCAN in software", "RTCAN", "plain CAN, DM")
    }
    assert jitter["TTCAN"] <= 2
    assert jitter["TTCAN in software"] <= 6 * 3 + 2
    assert jitter["RTCAN"] <= 6 * 3 + 2
    assert jitter["plain CAN, DM"] > 6 * 3 + 2


async def observed(network: FttCan | Ttcan, duration: float) -> list[FrameRecord]:
    network.start()
    await network.ready()
    records: list[FrameRecord] = []
    network.bus.observers.append(records.append)
    await asyncio.sleep(duration)
    network.close()
    return records


def test_asynchronous_frames_of_ftt_can_keep_out_of_the_synchronous_window_and_of_the_trigger() -> None:
    async def main() -> None:
        network = FttCan(ProtocolSetup(messages=named_set("thesis-95")))
        records = await observed(network, 0.1)
        flagged = {box.message.name for boxes in network.boxes.values() for box in boxes if box.replaces}
        names = {rank: message.name for rank, message in enumerate(network.set.by_deadline())}
        triggers = [each.start for each in records if each.frame.id == TRIGGER]
        assert {after - before for before, after in itertools.pairwise(triggers)} <= set(
            range(network.cycle - GUARD, network.cycle + GUARD)
        )
        synchronous = False
        for record in records:
            if record.frame.id == TRIGGER:
                synchronous = False
            elif names[record.frame.id - 0x10] in flagged:
                synchronous = True
            else:
                assert not synchronous

    run(main)


@pytest.mark.parametrize("errors", [1, 2, 3])
def test_what_an_error_keeps_from_a_window_of_ftt_can_does_not_delay_the_next_values(errors: int) -> None:
    async def main() -> int:
        network = FttCan(ProtocolSetup(messages=named_set("table-4.1")))
        network.start()
        await network.ready()
        rank = [each.name for each in network.set.by_deadline()].index("angle")  # two frames
        network.bus.disturb_next(count=errors, identifier=wire_identifier(OtherFrame(0x10 + rank)))
        await asyncio.sleep(0.03)
        begin = network.bus.timeline.now()
        await asyncio.sleep(0.1)
        verdict = network.tracks["angle"].judge(begin, network.bus.timeline.now())
        network.close()
        assert verdict.count > 5
        return verdict.missed

    assert run(main) == 0


@pytest.mark.parametrize("kind", [Ttcan, SoftwareTtcan])
@pytest.mark.parametrize("messages", ["thesis-80", "sae", "ford"])
def test_no_two_windows_of_a_matrix_overlap(kind: type[Ttcan], messages: str) -> None:
    async def main() -> None:
        network = kind(ProtocolSetup(messages=named_set(messages)))
        matrix = network.matrix
        for count in range(CYCLES):
            windows = [each for one in matrix.exclusive.values() for each in one if each.in_cycle(count)]
            spans = sorted([(each.start, each.end) for each in windows] + matrix.open[count])
            assert all(before[1] <= after[0] for before, after in itertools.pairwise(spans))
            assert spans[-1][1] <= matrix.basic
        assert all(matrix.period(name) <= network.tracks[name].message.period for name in matrix.exclusive)
        network.close()

    run(main)


def test_a_bit_error_costs_a_slot_with_ttcan_and_only_time_with_priorities() -> None:
    missed = {}
    for protocol in ("TTCAN", "plain CAN, DM"):
        case = StudyCase(protocol=protocol, messages="sae", bit_error_rate=1e-3, duration=0.2)
        missed[protocol] = simulate(case).periodic_missed
    assert missed["TTCAN"] > 5 * missed["plain CAN, DM"]


def test_a_babbling_node_of_low_priority_harms_slots_and_not_priorities() -> None:
    assert named_set("thesis-80").nodes[-1] == BABBLER
    missed = {
        protocol: simulate(StudyCase(protocol=protocol, messages="thesis-80", fault="low babble")).periodic_missed
        for protocol in ("TTCAN", "plain CAN, DM")
    }
    assert missed["TTCAN"] > 0
    assert missed["plain CAN, DM"] == 0


def test_rtcan_adds_a_message_without_any_change_to_the_others() -> None:
    added = add_message("RTCAN", "sae")
    assert (added.messages, added.nodes) == (0, 0)
    assert added.frames >= 2
    assert 0 < added.milliseconds < 100
    assert add_message("TTCAN", "sae").messages == 17


def test_random_sets_have_the_load_that_was_asked_for() -> None:
    for load in (0.2, 0.5, 0.95):
        assert random_set(1, load).load == pytest.approx(load, abs=0.02)
    assert random_set(1, 0.5) == random_set(1, 0.5) != random_set(2, 0.5)
