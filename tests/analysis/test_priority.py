"""Worst-case response times of plain CAN: published numbers, and what the simulated bus finds."""

import random
from pathlib import Path

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.analysis.sets import compare_plain
from benchmarks.analysis.simulated import Arrival, plain_responses
from r2p.analysis import (
    BusMessage,
    FaultModel,
    bit_time,
    breakdown,
    fault_probabilities,
    miss_probability,
    response_bounds,
    utilisation,
)
from r2p.analysis.tables import read_csv
from r2p.codecs.can_bits import INTERMISSION, OtherFrame, other_frame_bits
from r2p.errors import MessageError
from r2p.units import MILLISECOND

SETS = Path(__file__).parents[1] / "golden" / "sets"
SAE_125K = [1.416, 2.016, 2.536, 3.136, 3.656, 4.256, 5.016, 8.376, 8.976, 9.576, 10.096]
SAE_125K += [19.096, 19.616, 20.136, 28.976, 29.496, 29.520]
SAE_250K = [0.708, 1.008, 1.268, 1.568, 1.828, 2.128, 2.508, 2.768, 3.068, 3.368, 3.628]
SAE_250K += [3.968, 4.228, 4.488, 4.748, 5.008, 5.020]
SAE_500K = [0.354, 0.504, 0.634, 0.784, 0.914, 1.064, 1.254, 1.384, 1.534, 1.684, 1.814]
SAE_500K += [1.984, 2.114, 2.244, 2.374, 2.504, 2.510]
SAE_JITTER_125K = [1.54, 2.14, 2.66, 3.26, 3.78, 4.38, 5.24, 8.60, 9.20, 9.80, 10.32]
SAE_JITTER_125K += [19.32, 19.84, 20.36, 29.30, 29.82, 29.82]
"""In ms, until the last bit without jitter; those with jitter count the intermission."""
BROSTER = [1.028, 1.368, 1.708, 2.008, 2.428, 2.848, 3.228, 3.648, 4.028, 4.448, 4.708, 4.720]


def load(name: str, *, jitter: bool = False) -> list[BusMessage]:
    messages = read_csv((SETS / f"{name}.csv").read_text(encoding="utf-8")).messages
    return messages if jitter else [msgspec.structs.replace(each, jitter=0) for each in messages]


def bounds_ms(messages: list[BusMessage], bitrate: int, faults: int = 0) -> list[float]:
    found = response_bounds(messages, bit_time(bitrate), FaultModel(faults))
    return [each.bound / MILLISECOND for each in found if each.bound is not None]


# Davis, Burns, Bril and Lukkien 2007: the analysis of 1994 takes this set for schedulable


def test_the_counterexample_misses_its_deadline_in_the_second_instance() -> None:
    messages = load("davis_counterexample_125k")
    found = response_bounds(messages, bit_time(125_000))
    intermission = INTERMISSION * bit_time(125_000)
    assert [(each.bound or 0) for each in found] == [2_000_000 - intermission, 3_000_000 - intermission, 3_500_000]
    assert [each.misses for each in found] == [False, False, True]
    assert (found[2].instance, found[2].instances) == (1, 5)
    assert utilisation(messages, bit_time(125_000)) == pytest.approx(0.971, abs=0.001)


def _equally_long(identifiers: list[int]) -> tuple[int, dict[int, bytes]]:
    """Return seven bytes for each identifier such that all frames are equally long, and their bits."""
    lengths: dict[int, dict[int, bytes]] = {}
    for identifier in identifiers:
        for filling in range(256):
            data = bytes([filling]) * 7
            lengths.setdefault(other_frame_bits(OtherFrame(identifier, data)), {}).setdefault(identifier, data)
    bits = next(bits for bits, found in sorted(lengths.items()) if len(found) == len(identifiers) and bits % 2)
    return bits, lengths[bits]


def test_the_simulated_bus_shows_that_miss() -> None:
    bit = 8_000
    bits, data = _equally_long([1, 2, 3])  # with intermission an even number: the periods are 2.5 and 3.5 frames
    frame = (bits + INTERMISSION) * bit
    messages = [
        BusMessage(name=name, id=number, size=7, bits=bits, period=frame * period // 4, deadline=frame * deadline // 4)
        for number, (name, period, deadline) in enumerate((("A", 10, 10), ("B", 14, 13), ("C", 14, 13)), start=1)
    ]
    plan = {each.name: [Arrival(at, at) for at in range(0, 9 * frame, each.period or 1)] for each in messages}
    simulated = plain_responses(messages, bit, plan, {each.name: data[each.id] for each in messages})
    bounds = response_bounds(messages, bit)
    first, second = simulated["C"][:2]
    assert first <= (messages[2].deadline or 0) < second
    assert second == 14 * frame // 4 - INTERMISSION * bit
    assert all(max(simulated[each.message.name]) <= (each.bound or 0) for each in bounds)
    assert bounds[2].misses


# Published response times


def test_the_sae_benchmark_has_its_published_times() -> None:
    messages = load("sae_17_piggyback_2byte")
    assert bounds_ms(messages, 125_000) == SAE_125K
    assert bounds_ms(messages, 250_000) == SAE_250K
    assert bounds_ms(messages, 500_000) == SAE_500K
    assert bounds_ms(messages, 1_000_000) == [each / 2 for each in SAE_500K]


def test_with_jitter_one_more_round_of_interference_may_fit() -> None:
    with_jitter = bounds_ms(load("sae_17_piggyback_2byte", jitter=True), 125_000)
    # The message of least priority already has an intermission of blocking.
    assert [*[round(each + 0.024, 3) for each in with_jitter[:-1]], with_jitter[-1]] == SAE_JITTER_125K
    longer = load("sae_17_piggyback_ntu")
    before, after = bounds_ms(longer, 125_000), bounds_ms(load("sae_17_piggyback_ntu", jitter=True), 125_000)
    assert (round(before[13] + 0.024, 2), round(after[13] + 0.024, 2)) == (20.32, 28.92)


def test_broster_s_messages_have_their_published_times_also_with_faults() -> None:
    messages = load("broster12_250k")
    assert bounds_ms(messages, 250_000) == BROSTER
    for faults in range(11):
        found = bounds_ms(messages, 250_000, faults)
        assert found[7] == pytest.approx(3.648 + 0.644 * faults)
        if faults < 3:
            assert found[0] == pytest.approx(1.028 + 0.644 * faults)


def test_random_faults_are_as_likely_as_published() -> None:
    messages = load("broster12_250k")
    first = fault_probabilities(messages, "b1", bit_time(250_000), 30.0)
    assert [chance for _, chance in first[:3]] == pytest.approx([0.969631, 0.0293312, 9.99469e-4], rel=1e-5)
    assert fault_probabilities(messages, "b8", bit_time(250_000), 30.0)[0][1] == pytest.approx(0.896336, rel=1e-5)
    chances = [miss_probability(messages, "b1", bit_time(250_000), rate) for rate in (30.0, 300.0, 3000.0)]
    assert 0 <= chances[0] < chances[1] < chances[2] <= 1


def test_faults_that_come_again_and_again_are_counted_by_the_time() -> None:
    messages = load("broster12_250k")
    once = response_bounds(messages, 4000, FaultModel(0, 1_000 * MILLISECOND))
    assert [each.bound for each in once] == [each.bound for each in response_bounds(messages, 4000, FaultModel(1))]
    often = response_bounds(messages, 4000, FaultModel(0, 2 * MILLISECOND))
    assert all((a.bound or 0) > (b.bound or 0) for a, b in zip(often[2:], once[2:], strict=True))


def test_29_bit_frames_have_20_bits_and_5_stuff_bits_more() -> None:
    assert [BusMessage(name="", size=size).longest + 3 for size in range(9)] == [55 + 10 * size for size in range(9)]
    wide = [BusMessage(name="", size=size, extended=True) for size in range(9)]
    assert [each.longest + 3 for each in wide] == [80 + 10 * size for size in range(9)]
    truck = [msgspec.structs.replace(each, extended=True) for each in load("j1939_truck_rates")]
    assert bounds_ms(truck, 250_000)[0] == (160 + 160 - 3) * 4 / 1000


# What has no bound


def test_more_than_the_bus_carries_has_no_bound() -> None:
    messages = load("davis_counterexample_125k")
    found = response_bounds(messages, bit_time(110_000))
    assert [each.bound is None for each in found] == [False, False, True]
    assert found[2].misses


def test_what_is_sent_nobody_knows_how_often_blocks_and_leaves_those_below_without_a_bound() -> None:
    unknown = BusMessage(name="u", id=2, size=8)
    messages = [BusMessage(name=name, id=number, size=1, period=MILLISECOND) for name, number in (("a", 1), ("z", 3))]
    above, itself, below = response_bounds([*messages, unknown], 1000)
    assert (above.bound, itself.bound, below.bound) == ((65 - 3 + 135) * 1000, None, None)


def test_two_messages_with_one_identifier_are_an_error() -> None:
    twins = [BusMessage(name=name, id=7, size=1, period=MILLISECOND) for name in "ab"]
    with pytest.raises(MessageError, match="a and b have the same identifier 0x7"):
        response_bounds(twins, 1000)


# Breakdown


def test_the_breakdown_is_where_the_first_deadline_is_missed() -> None:
    messages = load("sae_17_piggyback_2byte", jitter=True)
    found = breakdown(messages, bit_time(125_000))
    assert 1 < found.scale < 1.2
    assert found.utilisation == pytest.approx(found.scale * utilisation(messages, 8000))
    within, beyond = int(8000 * found.scale), int(8000 * found.scale * 1.002)
    assert not any(each.misses for each in response_bounds(messages, within))
    assert any(each.misses for each in response_bounds(messages, beyond))
    assert breakdown(load("davis_counterexample_125k"), bit_time(125_000)).scale < 1


# The simulated bus is never slower than the bound


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.randoms(use_true_random=False), st.integers(1, 8), st.sampled_from([2000, 4000, 8000]))
def test_no_response_is_longer_than_its_bound(numbers: random.Random, count: int, bit: int) -> None:
    for each in compare_plain(numbers, count=count, bit=bit, duration=40 * MILLISECOND):
        assert each.bound is None or each.slowest <= each.bound
