"""One master and one rospy node for all tests with real ROS 1 programs.

Modules that use them have `pytestmark = pytest.mark.xdist_group("ros1")`, so that one worker of pytest-xdist runs all.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from tests.ros.ros1 import packages
from tests.ros.ros1.programs import Ros1, RospyPeer

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture(scope="session")
def ros1_usr() -> Path:
    """Where ROS 1's programs are; without them the test is skipped, and fails on CI."""
    found = packages.find()
    if isinstance(found, str):
        (pytest.fail if os.environ.get("CI") else pytest.skip)(found)
    return found


@pytest.fixture(scope="session")
def ros1(ros1_usr: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ros1]:
    """A master that lives as long as the tests; what a test registers there, it removes."""
    machine = Ros1(ros1_usr, tmp_path_factory.mktemp("ros1"))
    yield machine
    machine.close()


@pytest.fixture(scope="session")
def rospy_peer(ros1: Ros1) -> Iterator[RospyPeer]:
    """A rospy node `/peer`. A test unsubscribes and unadvertises what it has used."""
    with ros1.peer("peer") as peer:
        yield peer


@pytest.fixture
def own_ros1(ros1_usr: Path, tmp_path: Path) -> Iterator[Ros1]:
    """A master of this test's own, that it may end and restart; it takes half a second."""
    machine = Ros1(ros1_usr, tmp_path)
    yield machine
    machine.close()
