"""The estimate of UTC by network time: its claimed error holds for any number of measurements."""

from __future__ import annotations

import random

import pytest

from r2p.transports.rtcan import driver

INTERVAL = driver._MEASURE_INTERVAL


@pytest.mark.parametrize("count", [1, 2, 3, 5, 32])
def test_the_estimate_is_never_further_off_than_it_claims_until_the_next_measurement(count: int) -> None:
    """Interrupts jitter by 3 us at both ends of a sync; clocks differ by up to 200 ppm, also within a cycle."""
    numbers = random.Random(count)
    for _ in range(500):
        rate, offset = numbers.uniform(-2e-4, 2e-4), numbers.randrange(10**18)
        at, measured = 0, []
        for _ in range(count):
            at += INTERVAL + numbers.randrange(INTERVAL)
            jitter = numbers.uniform(-3_000, 3_000) + numbers.uniform(-3_000, 3_000)
            in_cycle = rate * numbers.randrange(10_000_000)
            measured.append((at, offset + round(rate * at + jitter + in_cycle)))
        found, error = driver._extrapolate(measured, at + INTERVAL // 2)
        for since in (0, INTERVAL // 2, INTERVAL):
            assert (
                abs(found - (offset + rate * (at + since))) <= error + 128
            )  # offsets of that size are multiples of it
        assert error < 100_000


def test_more_measurements_claim_less() -> None:
    claims = [
        driver._extrapolate([(at * INTERVAL, 0) for at in range(count)], count * INTERVAL)[1] for count in (1, 4, 32)
    ]
    assert claims == sorted(claims, reverse=True)
    assert claims[-1] < 7_000
