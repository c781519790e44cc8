"""The proximity module (thesis 7.5): four range finders, published in millimetres on `proximity`."""

import functools
import random
from collections.abc import Callable

import r2p
from r2p.msg import Proximity
from r2p.sim.modules.board import Board, Via
from r2p.sim.physics.rangefinder import RangeFinder, RangeSpec

Look = Callable[[int], float]
"""What is before sensor 0 to 3: its distance in mm, or infinity."""


class RangeArray:
    """Four sensors of one kind, and their inputs of the A/D converter."""

    def __init__(self, look: Look, noise: random.Random, spec: RangeSpec | None = None) -> None:
        self._look = look
        self._sensors = [RangeFinder(spec or RangeSpec(), noise) for _ in range(4)]

    def read(self) -> Proximity:
        """All four, corrected, in mm."""
        one, two, three, four = (
            sensor.millimetres(sensor.read(self._look(number))) for number, sensor in enumerate(self._sensors)
        )
        return Proximity(ranges=(one, two, three, four))


async def proximity(node: r2p.Node, sensors: RangeArray, topic: str, period: float) -> None:
    """Publish what the sensors see: event-triggered, for the most important thing is to react to it at once."""
    ranges = node.advertise(topic, Proximity, r2p.Sporadic(deadline=0.02))
    async for _ in node.every(period):
        await ranges.publish(sensors.read())


class ProximityModule(Board):
    """The module. `look(number)` says how far away what sensor 0 to 3 sees is, in mm."""

    def __init__(
        self,
        name: str = "PROX1",
        *,
        look: Look,
        noise: random.Random,
        spec: RangeSpec | None = None,
        topic: str = "proximity",
        period: float = 0.05,
        via: Via = None,
        remap: dict[str, str] | None = None,
    ) -> None:
        """`period` in seconds: the sensors need 40 ms for a measurement."""
        self.sensors = RangeArray(look, noise, spec)
        node = functools.partial(proximity, sensors=self.sensors, topic=topic, period=period)
        super().__init__(name, via=via, remap=remap, nodes={"prox": node})
