"""All cases of the study, their runs in parts, and the results as JSON. A part that has run is not run again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import msgspec

from benchmarks.protocols.cases import (
    FAULTS,
    PROTOCOLS,
    AddedMessage,
    CaseFigures,
    StudyCase,
    add_message,
    merge,
    simulate,
)
from benchmarks.protocols.discovery import DiscoveryShare, discovery_share

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from concurrent.futures import Executor
    from pathlib import Path

ERROR_RATES = (0.0, 1e-5, 1e-4)
LOADS = (20, 40, 60, 80, 95)
"""Percent, of random sets."""
SYNCLESS = ("plain CAN, RM", "plain CAN, DM", "Cyphal", "DroneCAN")
ADDED_TO = ("thesis-80", "sae")


class StudyPlan(msgspec.Struct, frozen=True):
    """How much is run: sets with their durations in s, without and with bit errors; random sets by
    load, with both, and their seeds; seeds of faults.
    """

    sets: dict[str, float]
    with_errors: dict[str, float]
    loads: tuple[int, ...] = LOADS
    load_seeds: int = 2
    load_duration: float = 1.5
    fault_seeds: int = 3
    discovery: bool = True


FULL = StudyPlan(
    {
        "thesis-80": 10.0,
        "thesis-95": 10.0,
        "table-4.1": 220.0,
        "sae": 310.0,
        "broster": 10.0,
        "vw": 10.0,
        "hyundai": 10.0,
        "j1939": 10.0,
        "ford": 115.0,
    },
    {
        "thesis-80": 10.0,
        "thesis-95": 5.0,
        "table-4.1": 20.0,
        "sae": 20.0,
        "broster": 10.0,
        "vw": 10.0,
        "hyundai": 10.0,
        "j1939": 10.0,
        "ford": 5.0,
    },
)
"""Without errors, each set with events has more than 5000 of them; all but `ford` have 10 000."""
QUICK = StudyPlan({"sae": 0.2}, {"sae": 0.1}, (20,), 1, 0.1, 1, discovery=False)


class StudyRow(msgspec.Struct, frozen=True):
    """A case with all its seeds, and its figures."""

    protocol: str
    messages: str
    bit_error_rate: float
    fault: str
    figures: CaseFigures


class ProtocolResults(msgspec.Struct):
    """What one protocol has to show. `added` is by set."""

    protocol: str
    plan: StudyPlan
    rows: list[StudyRow] = []
    added: dict[str, AddedMessage] = {}


class StudyResults(msgspec.Struct):
    """All protocols, in the order of the tables."""

    protocols: list[ProtocolResults]
    discovery: DiscoveryShare | None = None
    """Of r2p modules with the topics of `thesis-80`."""

    def figures(self, protocol: str, messages: str, bit_error_rate: float = 0.0, fault: str = "") -> CaseFigures | None:
        """Return the figures of a case; None: it was not run."""
        wanted = (protocol, messages, bit_error_rate, fault)
        for each in self.protocols:
            for row in each.rows:
                if (row.protocol, row.messages, row.bit_error_rate, row.fault) == wanted:
                    return row.figures
        return None


def cases_of(protocol: str, plan: StudyPlan) -> Iterator[list[StudyCase]]:
    """Yield the cases of one protocol, all seeds of one row together."""
    for name, duration in plan.sets.items():
        yield [StudyCase(protocol=protocol, messages=name, duration=duration)]
    for name, duration in plan.with_errors.items():
        for rate in ERROR_RATES[1:]:
            yield [StudyCase(protocol=protocol, messages=name, bit_error_rate=rate, duration=duration)]
    for load in plan.loads:
        for rate in ERROR_RATES:
            yield [
                StudyCase(
                    protocol=protocol,
                    messages=f"random-{load}",
                    bit_error_rate=rate,
                    seed=seed,
                    duration=plan.load_duration,
                )
                for seed in range(1, plan.load_seeds + 1)
            ]
    for fault in FAULTS:
        if protocol not in SYNCLESS or "babble" in fault:
            yield [
                StudyCase(protocol=protocol, messages="thesis-80", seed=seed, fault=fault)
                for seed in range(1, plan.fault_seeds + 1)
            ]


def run_protocol(protocol: str, plan: StudyPlan, pool: Executor) -> ProtocolResults:
    """Run all cases of one protocol."""
    groups = list(cases_of(protocol, plan))
    figures = iter(list(pool.map(simulate, [case for group in groups for case in group])))
    results = ProtocolResults(protocol, plan)
    for group in groups:
        merged = merge([next(figures) for _ in group])
        case = group[0]
        results.rows.append(StudyRow(protocol, case.messages, case.bit_error_rate, case.fault, merged))
    for name in ADDED_TO:
        results.added[name] = add_message(protocol, name)
    return results


def run_study(
    plan: StudyPlan,
    pool: Executor,
    cache: Path,
    show: Callable[[str], object],
    only: Sequence[str] = (),
) -> StudyResults:
    """Run what is not in the directory `cache` yet, one protocol after the other; `only` these anew."""
    cache.mkdir(parents=True, exist_ok=True)
    results = StudyResults([])
    for protocol in PROTOCOLS:
        file = cache / f"{protocol.replace(' ', '_').replace(',', '')}.json"
        found = None
        if protocol not in only and file.exists():
            found = msgspec.json.decode(file.read_bytes(), type=ProtocolResults)
        if found is None or found.plan != plan:
            show(f"running {protocol}")
            found = run_protocol(protocol, plan, pool)
            file.write_bytes(msgspec.json.encode(found))
        results.protocols.append(found)
    if plan.discovery:
        show("running r2p modules")
        results.discovery = pool.submit(discovery_share).result()
    return results
