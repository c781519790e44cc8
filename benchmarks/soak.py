"""A gateway from TCP to zenoh at full load, for as long as you like: `python -m benchmarks.soak SECONDS [--rate N]`.

A robot publishes as fast as it can, or N messages a second; a PC subscribes and stays; other subscribers and modules
join and leave every 0.2 s; a hostile client sends garbage, half lines and floods of management messages, and
reconnects. It prints a line per interval, and at the end a verdict (exit code 1 if it is bad):

- memory, file descriptors and threads of the gateway do not grow after the first fifth of the time;
- published = received + counted losses, at every hop, for the PC; for short-lived subscribers between their first and
  last message.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import median
from typing import Any

import msgspec

from benchmarks import soak_roles as roles
from benchmarks.processes import process

HOUR = 3600.0  # s
INTERVAL = 10.0
"""Seconds between two lines, at most."""

JUDGED = 120.0
"""Seconds that a run lasts at least if its memory is to be judged."""

_WARM_UP = 0.2
"""The part of a run in which tables fill, and memory may grow."""

_MB_PER_HOUR = 3.0
_MB_NOISE = 1.5
_SETTLED = 20.0  # s
_SENDING = ("no credit", "link down", "send buffer full")
_PAGE = 4096 / 1e6  # MB


class State(msgspec.Struct, frozen=True):
    """Of the gateway's process: seconds since the start, MB, number of file descriptors and threads."""

    at: float
    memory: float
    files: int
    threads: int


class Verdict(msgspec.Struct):
    """The result; `troubles` is empty if everything is well."""

    states: list[State] = []
    troubles: list[str] = []
    published: int = 0
    received: int = 0
    lives: int = 0
    connections: int = 0

    def hop(self, name: str, went_in: int, came_out: int, counted: int) -> str:
        """Compare the messages into a hop with those out of it and those counted; return a line about it."""
        difference = went_in - came_out - counted
        if difference:
            self.troubles.append(f"{name}: {difference} messages are in no counter")
        return f"{name}: {went_in} = {came_out} + {counted} counted" + f", {difference} MISSING" * bool(difference)


def state_of(pid: int, at: float) -> State:
    """Return what a process uses now."""
    proc = Path(f"/proc/{pid}")
    pages = int((proc / "statm").read_text().split()[1])
    return State(at, pages * _PAGE, len(list((proc / "fd").iterdir())), len(list((proc / "task").iterdir())))


def judge_growth(states: list[State]) -> Iterator[str]:
    """Yield what grew after the warm-up: compares the medians of its first and its last quarter."""
    warm = [each for each in states if each.at >= _WARM_UP * states[-1].at]
    quarter = max(1, len(warm) // 4)
    first, last = warm[:quarter], warm[-quarter:]
    hours = (median(each.at for each in last) - median(each.at for each in first)) / HOUR

    def grown(of: Callable[[State], float]) -> float:
        return median(map(of, last)) - median(map(of, first))

    if (memory := grown(lambda each: each.memory)) > _MB_NOISE + _MB_PER_HOUR * hours:
        yield f"the gateway's memory grew by {memory:.1f} MB in {60 * hours:.1f} minutes"
    if (files := grown(lambda each: each.files)) > 3:
        yield f"the gateway has {files:.0f} file descriptors more than after its warm-up"
    if (threads := grown(lambda each: each.threads)) > 3:
        yield f"the gateway has {threads:.0f} threads more than after its warm-up"


class Soak:
    """The processes, and pipes to ask them."""

    def __init__(self, stack: ExitStack, rate: float, seed: int) -> None:
        self._pipes: dict[str, Connection] = {}
        gateway = self._start(stack, "gateway", roles.gateway)
        self.gateway, lines, port = gateway.recv()
        for name, target, args in (
            ("pc", roles.pc, (port,)),
            ("robot", roles.robot, (lines, rate)),
            ("churn", roles.churn, (port,)),
            ("hostile", roles.hostile, (lines, seed)),
        ):
            self._start(stack, name, target, *args).recv()

    def _start(self, stack: ExitStack, name: str, target: Callable[..., object], *args: object) -> Connection:
        pipe = self._pipes[name] = stack.enter_context(process(target, *args))
        return pipe

    def ask(self, name: str, what: str = "report") -> Any:
        """Return the counters of a process."""
        self._pipes[name].send(what)
        return self._pipes[name].recv()

    def settled(self) -> dict[str, Any]:
        """Return the PC's counters once nothing has changed for two seconds on links that carry messages.

        Hostile clients, whose messages count for nothing, go on to the end.
        """
        counters = self.ask("pc")
        end, still, before = time.monotonic() + _SETTLED, 0, ""
        while still < 2 and time.monotonic() < end:
            time.sleep(1.0)
            counters = self.ask("pc")
            links = {name: each for name, each in self.ask("gateway")["links"].items() if each[:2] != (0, 0)}
            now = f"{self.ask('robot')} {links} {counters}"
            still, before = (still + 1, now) if now == before else (0, now)
        return dict(counters)


def soak(seconds: float, *, rate: float = 0.0, seed: int = 1, report: Callable[[str], object] = print) -> Verdict:
    """Run the soak; `rate` in messages/s, 0: as fast as possible. `report` is called with each line."""
    verdict = Verdict()
    with ExitStack() as stack:
        run = Soak(stack, rate, seed)
        _watch(run, seconds, verdict, report)
        _account(run, verdict, report)
    if seconds >= JUDGED:
        verdict.troubles += judge_growth(verdict.states)
    return verdict


def _watch(run: Soak, seconds: float, verdict: Verdict, report: Callable[[str], object]) -> None:
    began, received = time.monotonic(), 0
    interval = min(INTERVAL, seconds / 3)
    while (at := time.monotonic() - began) < seconds:
        time.sleep(min(interval, seconds - at))
        state = state_of(run.gateway, time.monotonic() - began)
        verdict.states.append(state)
        pc, churn = run.ask("pc"), run.ask("churn")
        rate, received = (pc["received"] - received) / (state.at - at), pc["received"]
        report(
            f"{state.at:7.0f} s  {rate:8.0f} messages/s  gateway {state.memory:6.1f} MB {state.files:3} files"
            f" {state.threads:3} threads  PC lost {pc['lost']} {pc['losses']}  {churn['lives']} lives"
            f" {churn['missing']} lost before them"
        )


def _account(run: Soak, verdict: Verdict, report: Callable[[str], object]) -> None:
    churn = run.ask("churn", "stop")
    run.ask("robot", "stop")
    verdict.connections = run.ask("hostile")
    pc = run.settled()
    robot, gateway = run.ask("robot"), run.ask("gateway")
    verdict.published, verdict.received, verdict.lives = robot["published"], pc["received"], churn["lives"]
    for line in _hops(robot, gateway, pc, verdict):
        report(line)
    _judge(robot, pc, churn, _lost_before_zenoh(robot, gateway), verdict)
    report(f"{churn['lives']} lives received {churn['received']}; {verdict.connections} hostile connections")
    report(f"losses: robot {robot['losses']}, PC {pc['losses']}")
    report(f"gateway {gateway['ports']} {gateway['links']}")


def _hops(robot: dict[str, Any], gateway: dict[str, Any], pc: dict[str, Any], verdict: Verdict) -> Iterator[str]:
    out = next(name for name in gateway["links"] if name.startswith("zenoh"))
    routes = [each for each in gateway["routes"] if each[1] == out and each[2]]
    source = routes[0][0] if routes else ""
    _, received, lost = gateway["links"].get(source, (0, 0, {}))
    forwarded, dropped = sum(each[2] for each in routes), sum(each[3] for each in routes)
    out_sent, _, out_lost = gateway["links"][out]
    waited = out_lost.get("converging", 0) - sum(each[4].get("converging", 0) for each in routes)
    yield verdict.hop("robot's publisher to its link", robot["published"], robot["sent"], _of(robot, *_SENDING))
    yield verdict.hop("robot's link to the gateway's", robot["sent"], received, _of({"losses": lost}, "wrong size"))
    yield verdict.hop("through the gateway", received, forwarded, dropped + gateway["ports"].get(source, 0))
    yield verdict.hop("to the gateway's zenoh link", forwarded, out_sent, _of({"losses": out_lost}, *_SENDING) + waited)
    on_the_way = _of(pc, "on the way", "wrong size", "wrong type", "repeated")
    yield verdict.hop("by zenoh to the PC", out_sent, pc["link"], on_the_way)
    queued = pc["queue"] + _of(pc, "receive queue full")
    yield verdict.hop("on the PC to its subscriber", pc["link"], pc["received"], queued)


def _lost_before_zenoh(robot: dict[str, Any], gateway: dict[str, Any]) -> int:
    """Return what robot and gateway count as lost: subscribers on zenoh can't count that."""
    lost: int = robot["published"] - robot["sent"]
    for name, (_, _, losses) in gateway["links"].items():
        lost += (
            _of({"losses": losses}, *_SENDING, "converging")
            if name.startswith("zenoh")
            else losses.get("wrong size", 0)
        )
    lost += sum(gateway["ports"].values()) + sum(each[3] for each in gateway["routes"])
    return lost


def _of(process: dict[str, Any], *reasons: str) -> int:
    return sum(process["losses"].get(reason, 0) for reason in reasons)


def _judge(robot: dict[str, Any], pc: dict[str, Any], churn: dict[str, Any], upstream: int, verdict: Verdict) -> None:
    """`upstream`: messages that never left the gateway, as the robot and the gateway count them."""
    if not pc["received"]:
        verdict.troubles.append("the PC received nothing")
    if robot["ups"] != 1 or pc["ups"] != 1:
        verdict.troubles.append(f"links broke: the robot's was up {robot['ups']} times, the PC's {pc['ups']}")
    for name, counters in (("the PC", pc), ("the short-lived subscribers", churn)):
        if counters["disorder"]:
            verdict.troubles.append(f"{name} got {counters['disorder']} messages in the wrong order")
    if churn["missing"] > roles.AT_ONCE * upstream:  # each live subscriber misses what was lost before zenoh
        verdict.troubles.append(
            f"{churn['missing']} messages of short-lived subscribers are in none of their counters, and robot and"
            f" gateway count {upstream}; the worst: {churn['worst']}"
        )


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.soak", description="A long run of a gateway under load")
    parser.add_argument("seconds", type=float, nargs="?", default=HOUR, help="how long; default: an hour")
    parser.add_argument("--rate", type=float, default=0.0, help="messages per second; default: as fast as possible")
    parser.add_argument("--seed", type=int, default=1, help="random seed of the hostile client")
    given = parser.parse_args()
    verdict = soak(given.seconds, rate=given.rate, seed=given.seed, report=lambda line: print(line, flush=True))
    for trouble in verdict.troubles:
        print("BAD", trouble)
    print("bad" if verdict.troubles else "good")
    return bool(verdict.troubles)


if __name__ == "__main__":
    sys.exit(main())
