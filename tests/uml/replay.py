"""Tests of one session run by a second pytest inside the user-mode kernel; the first one shows the reports as its own.

The second one writes each report to a file as a line of JSON; so failures look as if the tests had run here.
"""

from __future__ import annotations

import json
import os
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any, Literal

import pytest

from tests.uml import kernel, packages

MARK = "can"
LIMIT = 600.0
"""Seconds for all tests together."""

_REPORTS = "R2P_UML_REPORTS"
_SILENT_FOR = 60  # seconds; then the second pytest shows where it hangs


def inside() -> bool:
    """Whether this is the second pytest."""
    return _REPORTS in os.environ


class Writer:
    """A plugin of the second pytest: keeps the reports."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        data = self._config.hook.pytest_report_to_serializable(config=self._config, report=report)
        with Path(os.environ[_REPORTS]).open("a", encoding="utf-8") as file:
            file.write(json.dumps(data) + "\n")


class Replay:
    """The reports of one session's marked tests. The kernel runs when the first one is asked for."""

    def __init__(self, session: pytest.Session) -> None:
        self._session = session
        self._reports: dict[str, list[pytest.TestReport]] | None = None
        self._problem = ""
        self._outcome: Literal["failed", "skipped"] = "failed"

    def protocol(self, item: pytest.Item) -> None:
        """What pytest would do with a test, but for running it."""
        if self._reports is None:
            self._reports = self._run()
        hook = item.ihook
        hook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        reports = self._reports.get(_plain(item.nodeid), [])
        for report in reports:
            report.nodeid = item.nodeid
            hook.pytest_runtest_logreport(report=report)
        if not reports or reports[-1].when != "teardown":
            hook.pytest_runtest_logreport(report=self._missing(item))
        hook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)

    def _run(self) -> dict[str, list[pytest.TestReport]]:
        tools = packages.find()
        if isinstance(tools, str):
            self._problem = tools
            self._outcome = "failed" if os.environ.get("CI") else "skipped"
            return {}
        root = self._session.config.rootpath
        with kernel.folder() as shared:
            tests = [_plain(item.nodeid) for item in self._session.items if item.get_closest_marker(MARK)]
            (shared / "tests").write_text("\n".join(tests), encoding="utf-8")
            environment = {_REPORTS: str(shared / "reports"), "CI": os.environ.get("CI", "")}
            try:
                kernel.run(tools, shared, _pytest(shared), cwd=root, environment=environment, limit=LIMIT)
            except kernel.KernelFailed as error:
                self._problem = str(error)
            else:
                self._problem = f"it did not run; {kernel.tail(shared)}"
            return self._read(shared / "reports")

    def _read(self, file: Path) -> dict[str, list[pytest.TestReport]]:
        reports = defaultdict(list)
        hook = self._session.config.hook
        for line in file.read_text(encoding="utf-8").splitlines() if file.exists() else ():
            data: dict[str, Any] = json.loads(line)
            if isinstance(data["longrepr"], list):  # the place and the reason of a skip; JSON has no tuples
                data["longrepr"] = tuple(data["longrepr"])
            report = hook.pytest_report_from_serializable(config=self._session.config, data=data)
            reports[report.nodeid].append(report)
        return reports

    def _missing(self, item: pytest.Item) -> pytest.TestReport:
        """A report for a test that did not run, or not to its end."""
        text: Any = self._problem
        if self._outcome == "skipped":
            text = ("tests/can", 1, f"Skipped: {self._problem}")  # one place: pytest shows one line
        keywords: dict[str, Any] = dict.fromkeys(item.keywords, 1)
        return pytest.TestReport(item.nodeid, item.location, keywords, self._outcome, text, "setup")


def _plain(nodeid: str) -> str:
    """Without the group that pytest-xdist has added."""
    return nodeid.removesuffix(f"@{MARK}")


def _pytest(shared: Path) -> list[str]:
    """The order is the one of the first pytest, which may be random. What takes long to import there is left out."""
    without = ("randomly", "cacheprovider", "hypothesispytest", "xdist")
    plugins = [word for plugin in without for word in ("-p", f"no:{plugin}")]
    options = ["--color=no", "-o", f"faulthandler_timeout={_SILENT_FOR}", "-v"]
    return [sys.executable, "-m", "pytest", *plugins, *options, f"@{shared}/tests"]
