"""What was measured, by commit: files of JSON, and the comparison of two commits."""

import json
import re
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from benchmarks.table import Row

FOLDER = Path(__file__).with_name("results")

_FIGURE = re.compile(r"(?P<number>\d+(?:\.\d+)?) ?(?P<unit>M/s|k/s|k msg/s|images/s|s\b|ms|us|kB|bytes|%|x)?")
_RATES = {"M/s": (1e6, "/s"), "k/s": (1e3, "/s"), "k msg/s": (1e3, "/s")}
_SCALE = _RATES | {
    "M/s": (1e6, "/s"),
    "k/s": (1e3, "/s"),
    "k msg/s": (1e3, "/s"),
    "s": (1, "s"),
    "ms": (1e-3, "s"),
    "us": (1e-6, "s"),
}


def commit() -> str:
    """The commit of this working tree, 12 digits, with `-changed` where files differ; `unknown` without git."""
    try:
        head = _git("rev-parse", "--short=12", "HEAD").strip()
        return head + "-changed" * bool(_git("status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _git(*arguments: str) -> str:
    command = ("git", "-C", str(FOLDER.parent), *arguments)
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def known(folder: Path = FOLDER) -> list[str]:
    """The commits at which something was measured, the latest last."""
    return [path.stem for path in sorted(folder.glob("*.json"), key=lambda path: path.stat().st_mtime)]


class History:
    """The file of one commit: each run with the machine's state and its rows. Runs are added, never replaced."""

    def __init__(self, name: str, folder: Path = FOLDER) -> None:
        self._path = folder / f"{name}.json"
        self._runs: list[dict[str, Any]] = json.loads(self._path.read_text()) if self._path.exists() else []

    @property
    def runs(self) -> int:
        """How many runs there are."""
        return len(self._runs)

    def begin(self, machine: dict[str, str]) -> None:
        """Start a run."""
        self._runs.append({"machine": machine, "rows": []})

    def add(self, row: Row) -> None:
        """Add a row to the run, on disk too: a run that is broken off keeps what it has."""
        self._runs[-1]["rows"].append(row._asdict())
        self._path.parent.mkdir(exist_ok=True)
        self._path.write_text(json.dumps(self._runs, indent=1) + "\n")

    def measured(self) -> dict[str, list[str]]:
        """What each row measured, run by run."""
        rows: dict[str, list[str]] = {}
        for run in self._runs:
            for row in run["rows"]:
                rows.setdefault(row["what"], []).append(row["measured"])
        return rows


def compare(before: History, after: History) -> Iterator[tuple[str, str, str, str]]:
    """Rows that both have: what it is, the middle run of each, and the second as a multiple of the first."""
    old, new = before.measured(), after.measured()
    for what, values in new.items():
        if what in old:
            first, second = _middle(old[what]), _middle(values)
            yield what, first, second, _ratio(first, second)


def _middle(values: Sequence[str]) -> str:
    """The run in the middle, by its first figure."""
    return sorted(values, key=lambda text: (_figure(text) or (0.0, ""))[0])[(len(values) - 1) // 2]


def _ratio(first: str, second: str) -> str:
    before, after = _figure(first), _figure(second)
    if before is None or after is None or before[1] != after[1] or not before[0]:
        return ""
    return f"{after[0] / before[0]:.2f}x"


def _figure(text: str) -> tuple[float, str] | None:
    """The first figure of a row and its unit, in messages a second or in seconds where it is one of these."""
    found = _FIGURE.search(text)
    if found is None:
        return None
    scale, unit = _SCALE.get(found["unit"] or "", (1, found["unit"] or ""))
    return float(found["number"]) * scale, unit
