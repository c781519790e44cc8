"""Run all benchmarks, or those that are named: `python -m benchmarks delivery codecs`; compare two commits."""

import argparse
import importlib
import itertools
import logging
from collections.abc import Iterable, Iterator

from benchmarks import machine
from benchmarks.history import History, commit, compare, known
from benchmarks.table import Row, line, show

ALL = (
    "delivery",
    "calls",
    "priority",
    "codecs",
    "network",
    "zenoh",
    "zenoh_images",
    "ros1",
    "ros2",
    "irobot",
    "arrays",
    "payloads",
    "peers",
    "gateway",
    "foxglove",
    "recording",
    "recording_edit",
    "monitoring",
    "top",
    "rtcan",
    "admission",
    "simulated_can",
    "timers",
    "slots_on_pcs",
    "playing",
    "dash",
    "browser",
    "start",
    "socketcan",
    "frames",
    "served_can",
)

COMPARED = (64, 40, 40, 15)


def main() -> None:
    arguments = _parse()
    if arguments.compare:
        _compare(*arguments.compare)
        return
    logging.disable()
    names = arguments.names or ALL
    run(itertools.chain.from_iterable(importlib.import_module(f"benchmarks.{name}").rows() for name in names))


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(ALL)}; all if none is named")
    parser.add_argument("--compare", nargs=2, metavar=("A", "B"), help="what was measured at two commits, side by side")
    arguments = parser.parse_args()
    for unknown in set(arguments.names) - {*ALL}:
        parser.error(f"{unknown!r} is not a benchmark: take one of {', '.join(ALL)}")
    return arguments


def run(rows: Iterable[Row]) -> None:
    """Print rows below what the machine is and does, and keep them with the commit."""
    state, history = machine.describe(), History(commit())
    print(*machine.lines(state), "", sep="\n")
    history.begin(state)

    def kept() -> Iterator[Row]:
        for row in rows:
            history.add(row)
            yield row

    show(kept())
    print(f"\nload at the end {machine.load()}; kept as `--compare` has it: {commit()}")


def _compare(first: str, second: str) -> None:
    before, after = History(first), History(second)
    for name, history in ((first, before), (second, after)):
        if not history.runs:
            raise SystemExit(f"nothing was measured at {name}: there are {', '.join(known()) or 'no measurements'}")
    print(line(("what", first, second, "second to first"), COMPARED))
    print(line(tuple("-" * width for width in COMPARED), COMPARED))
    for row in compare(before, after):
        print(line(row, COMPARED))


if __name__ == "__main__":
    main()
