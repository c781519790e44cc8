"""How far apart modules sample: what must be so whatever the jitter and the number of modules."""

from __future__ import annotations

import pytest

from benchmarks import misalignment


@pytest.mark.parametrize(("modules", "jitter"), [(2, 0), (2, 1_000), (6, 3_000)])
def test_syncs_are_apart_by_twice_the_jitter_at_most_and_ticks_by_less(modules: int, jitter: int) -> None:
    syncs, ticks = misalignment.measure(modules, jitter, 2.0)
    assert syncs.count > 190
    assert ticks.count > 190
    assert syncs.largest <= 2 * jitter / 1000
    assert ticks.mean <= max(syncs.mean / 2, 0.1)
    assert ticks.largest <= max(syncs.largest, 0.5)


def test_the_same_seed_gives_the_same_figures() -> None:
    assert misalignment.measure(2, 1_000, 0.2) == misalignment.measure(2, 1_000, 0.2)
