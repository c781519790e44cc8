"""iRobot's network `sierra_nevada` and a larger one: r2p over each link, beside rclpy (Fast DDS) and rospy, in turn."""

import contextlib
import functools
import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.robot_networks.plans import MADE_UP, SIERRA_NEVADA, NodePlan, Plan
from benchmarks.table import Row, p50_p99
from r2p.codecs.rtcan import VARIABLE_MAX
from tests.ros.rclpy import install
from tests.ros.ros1 import packages
from tests.ros.ros1.programs import Ros1

SECONDS = 5.0
SETTLED = 1.0
"""Seconds that pass after each subscription has received its first message."""

_FOLDER = Path(__file__).with_name("robot_networks")
_ZENOH = "zenoh:{}?mode=peer&listen=tcp/127.0.0.1:0&scouting=off&network=irobot"
_IN_ONE, _ACROSS = 3.0, 2.0
"""How many times less processor time than rclpy is the goal, in one process and in several."""


class Outcome(NamedTuple):
    """What all processes of a network measured: shares of one core, bytes, messages, and latencies (ns)."""

    cpu: float
    rss: int
    expected: int
    received: int
    late: int
    too_late: int
    lost: int
    latencies: list[int]

    def figures(self) -> str:
        """Everything but what is the goal's."""
        p50, p99 = p50_p99(self.latencies, 1e6)
        return (
            f"{self.cpu:.1%} of a core, {self.rss / 1e6:.0f} MB, {p50:.2f}/{p99:.2f} ms, "
            f"late {self.late}+{self.too_late}, lost {self.lost}, received {self.received / self.expected:.0%}"
        )

    @property
    def each(self) -> float:
        """Seconds of processor time for each message that was received: who skips periods takes less in all."""
        return self.cpu * SECONDS / max(self.received, 1)


Process = subprocess.Popen[str]


def rows() -> Iterator[Row]:
    yield from sierra_nevada()
    yield from made_up()


def sierra_nevada() -> Iterator[Row]:
    """The one that is known."""
    yield from _network(SIERRA_NEVADA)


def made_up() -> Iterator[Row]:
    """20 nodes, 23 topics, 35 subscriptions, up to 250 kB: made up for this."""
    yield from _network(MADE_UP)


def _network(plan: Plan) -> Iterator[Row]:
    whole, halves, single = [plan.nodes], [plan.half(0), plan.half(1)], [(node,) for node in plan.nodes]
    many = f"{plan.name}, {len(single)} processes, zenoh"
    with _rclpy(plan) as rclpy:
        theirs = rclpy(whole)
        yield _row(f"{plan.name}, one process", _measure(plan, _r2p(plan, whole, "")), "rclpy", theirs, _IN_ONE)
        theirs = rclpy(halves)
        for name, link in (("TCP", "tcp"), ("zenoh", "zenoh")):
            ours = _measure(plan, _r2p(plan, halves, link))
            yield _row(f"{plan.name}, two processes, {name}", ours, "rclpy", theirs, _ACROSS)
        theirs = rclpy(single)
    ours = _measure(plan, _r2p(plan, single, "zenoh"))
    yield _row(many, ours, "rclpy", theirs, _ACROSS)
    yield _row(many, ours, "rospy", _rospy(plan), None)
    small = plan.up_to(VARIABLE_MAX)
    measured = _measure(small, _r2p(plan, whole, "can")).figures()
    what = f"{plan.name}, simulated CAN of 1 Mbit/s in real time"
    yield Row(what, measured, f"{len(small.topics)} of {len(plan.topics)} topics fit", "", None)


def _row(what: str, ours: Outcome, peer: str, theirs: Outcome | None, goal: float | None) -> Row:
    if theirs is None:
        return Row(what, ours.figures(), f"{peer} is missing", "", None)
    baseline = f"{peer} {theirs.figures()}: {theirs.each / ours.each:.1f}x each"
    if goal is None:
        return Row(what, ours.figures(), baseline, "", None)
    late = ours.late + ours.too_late <= theirs.late + theirs.too_late
    reached = ours.each * goal <= theirs.each and late and ours.lost <= theirs.lost
    return Row(what, ours.figures(), baseline, f"1/{goal:.0f} of its CPU for each, no more late or lost", reached)


def _measure(plan: Plan, starting: Iterator[Process]) -> Outcome:
    """Start the processes, let them find each other, and add up what they measure."""
    processes: list[Process] = []
    try:
        for process in starting:
            processes.append(process)  # noqa: PERF402  # so that those that run end where one can't start
        for process in processes:
            _until(process, "ready")
        time.sleep(SETTLED)
        _tell(processes, "begin")
        time.sleep(SECONDS)
        _tell(processes, "end")
        return _sum(plan, [json.loads(_line(process)) for process in processes])
    finally:
        for process in processes:
            _end(process)


def _end(process: Process) -> None:
    """Those that have given their result end on their own: Fast DDS leaves files where it is killed."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.communicate(timeout=3.0)
    process.kill()
    process.communicate()


def _sum(plan: Plan, results: Sequence[dict[str, Any]]) -> Outcome:
    added = {name: sum(each[name] for each in results) for name in results[0] if name != "latencies"}
    latencies = list(itertools.chain.from_iterable(each["latencies"] for each in results))
    topics = plan.topics
    expected = sum(int(SECONDS / topics[name].period) for node in plan.nodes for name in node.subscribes)
    return Outcome(expected=expected, latencies=latencies, **added)


def _tell(processes: Sequence[Process], word: str) -> None:
    for process in processes:
        assert process.stdin
        print(word, file=process.stdin, flush=True)


def _line(process: Process) -> str:
    assert process.stdout
    line = process.stdout.readline()
    assert line, f"{process.args!r} has ended"
    return line


def _until(process: Process, word: str) -> None:
    while json.loads(_line(process)) != word:
        pass


_start = functools.partial(subprocess.Popen, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def _r2p(plan: Plan, parts: Sequence[tuple[NodePlan, ...]], link: str) -> Iterator[Process]:
    """A process for each part; all but the first connect to that."""
    listen = {"tcp": "tcp-listen:127.0.0.1:0", "zenoh": _ZENOH.format("")}.get(link, link)
    connect = {"tcp": "tcp:127.0.0.1:{}", "zenoh": _ZENOH.format("tcp/127.0.0.1:{}")}.get(link, "")
    port = ""
    for nodes in parts:
        via = connect.format(port) if port else listen
        process = _start([sys.executable, "-m", "benchmarks.robot_networks.r2p_end", plan.name, via, *_names(nodes)])
        addresses = json.loads(_line(process))
        port = port or next(iter(addresses.values()), "").rpartition(":")[2]
        yield process


def _names(nodes: Sequence[NodePlan]) -> list[str]:
    return [node.name for node in nodes]


@contextlib.contextmanager
def _rclpy(plan: Plan) -> Iterator[Callable[[Sequence[tuple[NodePlan, ...]]], Outcome | None]]:
    """How to measure rclpy with a process for each part; on the loopback interface, as all of the others."""
    python = install.find()
    with tempfile.TemporaryDirectory() as home:
        own = {"ROS_LOCALHOST_ONLY": "1", "ROS_DOMAIN_ID": str(os.getpid() % 100 + 1), "ROS_LOG_DIR": home}
        command = [str(python), str(_FOLDER / "rclpy_end.py"), plan.name]
        start = functools.partial(_start, env=os.environ | own, stderr=subprocess.DEVNULL)

        def measure(parts: Sequence[tuple[NodePlan, ...]]) -> Outcome | None:
            if isinstance(python, str):
                return None
            return _measure(plan, (start([*command, *_names(nodes)]) for nodes in parts))

        yield measure


def _rospy(plan: Plan) -> Outcome | None:
    """A process for each node: rospy has no other way."""
    usr = packages.find()
    if isinstance(usr, str):
        return None
    with tempfile.TemporaryDirectory() as home, contextlib.closing(Ros1(usr, Path(home))) as ros1:
        command = [packages.PYTHON, str(_FOLDER / "rospy_end.py"), plan.name]
        start = functools.partial(_start, env=ros1.environment, stderr=subprocess.DEVNULL)
        return _measure(plan, (start([*command, node.name]) for node in plan.nodes))
