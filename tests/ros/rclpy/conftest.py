"""One process of rclpy for the whole run; the tests that use it are all in one worker."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from tests.ros.rclpy import install
from tests.ros.rclpy.peer import RclpyPeer

if TYPE_CHECKING:
    from collections.abc import Generator


@pytest.fixture(scope="session")
def rclpy_process(tmp_path_factory: pytest.TempPathFactory) -> Generator[RclpyPeer, None, None]:
    python = install.find()
    if isinstance(python, str):
        if os.environ.get("CI"):
            pytest.fail(python)
        pytest.skip(python)
    with RclpyPeer(python, tmp_path_factory.mktemp("rclpy")) as peer:
        yield peer


@pytest.fixture
def rclpy_peer(rclpy_process: RclpyPeer) -> Generator[RclpyPeer, None, None]:
    """The process, without nodes and reports of other tests."""
    yield rclpy_process
    rclpy_process.ask("destroy_all")
    rclpy_process.forget()
