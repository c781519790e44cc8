"""RTCAN beside other protocols, in virtual time: tables, pictures and results of docs/comparison.md.

    python -m benchmarks.protocols [--quick] [--jobs 1] [--only PROTOCOL ...] [--cache DIRECTORY] [--write]

Without options everything is run that `--cache` does not have, and the tables are printed. `--write` also puts them
into docs/comparison.md, and the results and pictures beside it. The same seeds give the same figures.
"""

from __future__ import annotations

import argparse
import logging
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.protocols import page, pictures
from benchmarks.protocols.cases import PROTOCOLS
from benchmarks.protocols.study import FULL, QUICK, run_study

if TYPE_CHECKING:
    from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.protocols", description="RTCAN beside other protocols")
    parser.add_argument("--quick", action="store_true", help="one small set, short runs: only to see that it works")
    parser.add_argument("--jobs", type=int, default=1, help="runs at the same time")
    parser.add_argument("--only", nargs="+", choices=PROTOCOLS, default=(), help="run these anew")
    parser.add_argument("--cache", type=Path, help="a directory to keep the results of each protocol in")
    parser.add_argument("--write", action="store_true", help="write page, pictures and results into docs/")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as scratch, ProcessPoolExecutor(options.jobs, initializer=_quiet) as pool:
        cache = options.cache or Path(scratch)
        plan = QUICK if options.quick else FULL
        results = run_study(plan, pool, cache, lambda text: print(text, flush=True), options.only)
    for name, lines in page.tables(results).items():
        print(f"\n{name}:\n")
        print("\n".join(lines))
    if options.write:
        page.write(results)
        pictures.draw(results, page.ASSETS)


def _quiet() -> None:
    """Log nothing: a bus that breaks down makes nodes complain."""
    logging.disable(logging.CRITICAL)


if __name__ == "__main__":
    main()
