"""The power supply module (thesis 7.2): measures voltage and current of the battery, and publishes `battery`.

What is left in the battery it does not know: that takes a calibration, and so a node of the robot's.
"""

import functools

import r2p
from r2p.msg import Battery as BatteryMessage
from r2p.sim.modules.board import Board, Via
from r2p.sim.physics.battery import Battery

_VOLTAGE_COUNT = 36_000 / 4095  # mV for each count of the A/D converter: the divider makes 3.3 V of 36 V
_CURRENT_COUNT = 50_000 / 4095  # mA


def measured(battery: Battery) -> BatteryMessage:
    """What the A/D converter sees of it, with a resolution of 9 mV and 12 mA; its charge is not calibrated."""
    return BatteryMessage(
        voltage=round(round(battery.voltage * 1000 / _VOLTAGE_COUNT) * _VOLTAGE_COUNT),
        current=max(-32768, min(32767, round(round(battery.current * 1000 / _CURRENT_COUNT) * _CURRENT_COUNT))),
        charge=255,
        remaining=65535,
    )


async def power(node: r2p.Node, battery: Battery, topic: str, period: float) -> None:
    """Publish the measurements."""
    measurements = node.advertise(topic, BatteryMessage)
    async for _ in node.every(period):
        await measurements.publish(measured(battery))


class PowerModule(Board):
    """The module. `battery` is what it is connected to: whoever made it moves it on, in a `Plant`."""

    def __init__(
        self,
        name: str = "PS",
        *,
        battery: Battery,
        topic: str = "battery",
        period: float = 0.5,
        via: Via = None,
        remap: dict[str, str] | None = None,
    ) -> None:
        """`period` in seconds."""
        self.battery = battery
        node = functools.partial(power, battery=battery, topic=topic, period=period)
        super().__init__(name, via=via, remap=remap, nodes={"power": node})
