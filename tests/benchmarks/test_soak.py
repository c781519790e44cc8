"""The harness of the soak: a short run at a low load adds up, and what grows or is missing is found."""

from __future__ import annotations

import pytest

from benchmarks.soak import State, Verdict, _judge, judge_growth, soak
from benchmarks.soak_roles import Account, Lives


def test_a_short_run_adds_up() -> None:
    lines: list[str] = []
    verdict = soak(2.0, rate=500.0, report=lines.append)
    assert verdict.troubles == []
    assert verdict.published >= verdict.received > 0
    assert verdict.lives > 0
    assert verdict.connections > 0
    assert sum("messages/s" in line for line in lines) == len(verdict.states) >= 3


def flat(count: int = 40) -> list[State]:
    return [State(float(at), 50.0 + at % 2, 40 + at % 3, 20) for at in range(count)]


def test_a_process_that_stays_as_it_is_is_judged_flat() -> None:
    warming = [State(float(at), 10.0 + at, 10, 10) for at in range(8)]
    assert list(judge_growth([*warming, *(State(each.at + 8, *_rest(each)) for each in flat())])) == []


@pytest.mark.parametrize(
    ("memory", "files", "threads", "said"),
    [(0.2, 0, 0, "memory grew"), (0, 1, 0, "file descriptors"), (0, 0, 1, "threads")],
)
def test_what_grows_is_found(memory: float, files: int, threads: int, said: str) -> None:
    states = [State(at, 50 + memory * at, 40 + files * int(at), 20 + threads * int(at)) for at in map(float, range(40))]
    (trouble,) = judge_growth(states)
    assert said in trouble


def _rest(state: State) -> tuple[float, int, int]:
    return state.memory, state.files, state.threads


def test_a_hop_that_does_not_add_up_is_bad() -> None:
    verdict = Verdict()
    assert "MISSING" not in verdict.hop("a", 10, 8, 2)
    assert verdict.troubles == []
    assert "1 MISSING" in verdict.hop("b", 10, 8, 1)
    assert verdict.hop("c", 10, 8, 3).endswith("-1 MISSING")
    assert len(verdict.troubles) == 2


def test_what_one_that_came_and_went_missed_has_to_be_in_a_counter() -> None:
    account, lives = Account(), Lives()
    for number in (5, 6, 9, 8, 12):
        account.add(number)
    assert (account.received, account.missing, account.disorder) == (5, 5, 1)
    lives.add(account, 5, {})
    assert lives.missing == 0
    lives.add(account, 3, {"on the way": 3})
    lives.add(Account(), 0, {})
    assert (lives.lives, lives.silent, lives.missing) == (3, 1, 2)


def test_what_was_lost_before_zenoh_is_in_the_counters_of_robot_and_gateway() -> None:
    verdict = Verdict()
    said = {"received": 1, "ups": 1, "disorder": 0}
    churn = {"disorder": 0, "missing": 20, "worst": ""}
    _judge(said, said, churn, 10, verdict)
    assert verdict.troubles == []
    _judge(said, said, churn, 9, verdict)
    assert len(verdict.troubles) == 1
