"""Measures how the cost of r2p grows: `python -m benchmarks.growth tcp_clients router_mesh --json growth.json`."""

import argparse
import importlib
import logging
from pathlib import Path

import msgspec

from benchmarks.growth.curve import Curve

PARTS = (
    "memory_modules",
    "rtcan_modules",
    "zenoh_modules",
    "zenoh_network",
    "tcp_clients",
    "gateway_topics",
    "router_mesh",
)


def _show(curve: Curve) -> None:
    last = curve.points[-1][1]
    goal = "" if curve.goal is None else f", goal {curve.goal:g}: {'yes' if last <= curve.goal else 'NO'}"
    power = "" if curve.exponent is None else f", N^{curve.exponent:.2f}"
    print(f"{curve.name} ({curve.unit}){power}{goal}")
    for n, value in curve.points:
        print(f"  {n:6d} {curve.n_is}: {value:.3g}", flush=True)


def main() -> None:
    """Measure the parts that are named, or all; `--json` puts the results in a file, beside those of other parts."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.growth", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--json", type=Path, help="the file of results, from which `benchmarks.growth.draw` draws")
    options = parser.parse_args()
    if unknown := set(options.parts) - set(PARTS):
        parser.error(f"there is no part {', '.join(sorted(unknown))}")
    logging.disable()
    for part in options.parts or PARTS:
        curves: list[Curve] = importlib.import_module(f"benchmarks.growth.{part}").curves()
        for curve in curves:
            _show(curve)
        if options.json is not None:
            _keep(options.json, part, curves)


def _keep(path: Path, part: str, curves: list[Curve]) -> None:
    known: dict[str, list[Curve]] = {}
    if path.exists():
        known = msgspec.json.decode(path.read_bytes(), type=dict[str, list[Curve]])
    path.write_bytes(msgspec.json.format(msgspec.json.encode(known | {part: curves}), indent=1) + b"\n")


if __name__ == "__main__":
    main()
