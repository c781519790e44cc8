"""Both loops are used in turn elsewhere; what these tests are about lies behind them, so one is enough."""

from typing import Any

import pytest


@pytest.fixture(scope="module")
def anyio_backend() -> tuple[str, dict[str, Any]]:
    return "asyncio", {}
