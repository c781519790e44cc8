"""The clock of the physics."""

import asyncio

import pytest

from r2p.sim.modules.plant import Plant


class Count:
    """Adds up its steps."""

    def __init__(self) -> None:
        self.time = 0.0

    def step(self, dt: float) -> None:
        self.time += dt


@pytest.mark.virtual_time
async def test_it_goes_as_the_loops_time_goes_and_ends_with_its_block() -> None:
    count = Count()
    async with Plant([count], dt=0.002) as plant:
        await asyncio.sleep(1.0005)
        assert plant.steps == 500
        assert count.time == pytest.approx(1.0)
    await asyncio.sleep(1)
    assert plant.steps == 500


def test_parts_step_in_their_order() -> None:
    order: list[str] = []

    class Named:
        def __init__(self, name: str) -> None:
            self._name = name

        def step(self, dt: float) -> None:
            order.append(self._name)

    Plant([Named("drive"), Named("body")]).step(2)
    assert order == ["drive", "body", "drive", "body"]


def test_what_a_blocked_loop_missed_is_made_up_for_within_reason() -> None:
    plant = Plant(dt=0.01)
    plant._tick(0, 0, 20)
    assert plant.steps == 21
    plant._tick(0, 0, 1_000_000)
    assert plant.steps == 21 + 101
