"""Runs all benchmarks, or those that are named: `python -m benchmarks delivery codecs`."""

import importlib
import itertools
import logging
import sys

from benchmarks.table import show

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
    "gateway",
    "foxglove",
    "recording",
    "recording_edit",
    "monitoring",
    "top",
    "rtcan",
    "simulated_can",
    "timers",
    "playing",
    "dash",
    "browser",
    "start",
    "socketcan",
    "frames",
    "served_can",
)


def main() -> None:
    logging.disable()
    names = sys.argv[1:] or ALL
    show(itertools.chain.from_iterable(importlib.import_module(f"benchmarks.{name}").rows() for name in names))


if __name__ == "__main__":
    main()
