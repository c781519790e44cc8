"""Sends the tests marked `can` to the user-mode kernel, all of them in one run."""

from __future__ import annotations

import pytest

from tests.can import rig
from tests.uml import replay

_REPLAY = pytest.StashKey[replay.Replay]()


def pytest_configure(config: pytest.Config) -> None:
    if replay.inside():
        config.pluginmanager.register(replay.Writer(config))


@pytest.hookimpl(tryfirst=True)  # before pytest-xdist reads the groups
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give all of them to one worker of pytest-xdist, as there is one kernel."""
    for item in items:
        if item.get_closest_marker(replay.MARK) and not replay.inside():
            item.add_marker(pytest.mark.xdist_group(replay.MARK))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> bool | None:
    if replay.inside() or not item.get_closest_marker(replay.MARK):
        return None
    item.session.stash.setdefault(_REPLAY, replay.Replay(item.session)).protocol(item)
    return True


@pytest.fixture
def vcan() -> str:
    """A virtual CAN interface of this test. It ends with the kernel."""
    name = rig.new_name()
    rig.add(name)
    return name
