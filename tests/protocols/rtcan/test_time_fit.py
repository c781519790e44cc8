"""The line through the syncs of a node: less jitter than its stamps, no drift, and no trust in single ones."""

import random

import pytest

from r2p.protocols.rtcan.time_fit import NetworkTimeFit

CYCLE = 9_960_000
PPM = 1e-6


def synced(
    fit: NetworkTimeFit, count: int, *, first: int = 1, rate: float = 0.0, jitter: int = 0, seed: int = 1
) -> None:
    """Add syncs of cycles `first` and on, of a network that is faster than the node's clock by `rate`."""
    numbers = random.Random(seed)
    for counter in range(first, first + count):
        at = round(counter * CYCLE / (1.0 + rate)) + numbers.randint(-jitter, jitter)
        if fit.known:
            fit.add(at, counter * CYCLE)
        else:
            fit.begin(at, counter * CYCLE)


@pytest.mark.parametrize("rate", [-200 * PPM, 0.0, 200 * PPM])
def test_a_line_has_a_part_of_the_jitter(rate: float) -> None:
    fit = NetworkTimeFit()
    synced(fit, 100, rate=rate, jitter=3_000)
    worst = 0
    for counter in range(101, 500):
        synced(fit, 1, first=counter, rate=rate, jitter=3_000, seed=counter)
        true = round((counter + 0.5) * CYCLE / (1.0 + rate))
        worst = max(worst, abs(fit.time(true) - (2 * counter + 1) * CYCLE // 2))
    assert worst < 2_000


def test_without_syncs_it_goes_on_at_the_last_rate() -> None:
    fit = NetworkTimeFit()
    synced(fit, 200, rate=150 * PPM, jitter=1_000)
    true = round(500 * CYCLE / (1.0 + 150 * PPM))
    assert abs(fit.time(true) - 500 * CYCLE) < 6_000  # 3 s later; the clock alone would be off by 450 us


@pytest.mark.parametrize("off", [-100_000, 100_000])
def test_a_stray_sync_moves_nothing(off: int) -> None:
    fit = NetworkTimeFit()
    synced(fit, 100)
    fit.add(101 * CYCLE + off, 101 * CYCLE)
    assert fit.time(102 * CYCLE) == 102 * CYCLE


@pytest.mark.parametrize("off", [-100_000, 100_000])
def test_four_of_them_are_the_time(off: int) -> None:
    fit = NetworkTimeFit()
    synced(fit, 100)
    for counter in range(101, 105):
        fit.add(counter * CYCLE + off, counter * CYCLE)
    assert abs(fit.time(105 * CYCLE + off) - 105 * CYCLE) < 10


def test_a_port_whose_stamps_are_coarse_is_followed_as_well() -> None:
    fit = NetworkTimeFit()
    synced(fit, 300, rate=100 * PPM, jitter=50_000)
    assert abs(fit.time(round(300 * CYCLE / (1.0 + 100 * PPM))) - 300 * CYCLE) < 40_000


def test_another_master_has_another_drift() -> None:
    fit = NetworkTimeFit()
    synced(fit, 100, rate=200 * PPM)
    at, time = round(100 * CYCLE / (1.0 + 200 * PPM)), 100 * CYCLE
    worst = 0
    for number in range(1, 100):
        worst = max(worst, abs(fit.time(at + number * CYCLE) - time - number * CYCLE))
        fit.add(at + number * CYCLE, time + number * CYCLE, changed=number == 1)
    assert worst < 5_000
    assert abs(fit.time(at + 100 * CYCLE) - time - 100 * CYCLE) < 100


def test_an_instant_is_the_first_one_of_its_time() -> None:
    fit = NetworkTimeFit()
    synced(fit, 50, rate=37 * PPM, jitter=500)
    for time in range(50 * CYCLE, 52 * CYCLE, 77_777):
        assert fit.time(fit.instant(time)) >= time > fit.time(fit.instant(time) - 1)


def test_stamps_that_run_backwards_are_left_out() -> None:
    fit = NetworkTimeFit()
    synced(fit, 50)
    before = fit.time(60 * CYCLE)
    fit.add(50 * CYCLE, 51 * CYCLE)
    fit.add(40 * CYCLE, 40 * CYCLE)
    assert fit.time(60 * CYCLE) == before
