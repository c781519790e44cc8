"""A robot of 20 modules on one bus: it starts within what the protocol's times add up to, whatever the seed."""

from __future__ import annotations

from benchmarks import twenty_modules
from r2p import sim

LISTEN, SPREAD, OBJECTION = 1.2, 0.05, 0.25  # s, of a node that claims an id
CLAIM_APART = 0.1  # s, if two nodes wanted the same one
ELECTION, RETRY = 0.1, 0.25  # s: three cycles for claims, twice as long with a better candidate; of requests for slots
ROUND = 1.5  # s in which everything is announced once more


def test_all_modules_start_at_once() -> None:
    found = sim.run(lambda: twenty_modules.start(7, watched=0.0), seed=7)
    assert LISTEN + OBJECTION <= found.ids <= LISTEN + SPREAD + OBJECTION + CLAIM_APART
    assert found.master <= found.ids + ELECTION
    assert found.slots <= found.master + RETRY
    assert found.known <= found.slots + ROUND
    assert found.frames.get("errors", 0) < 5
    assert found.bits["management"] < 0.16
