"""The input/output module (thesis 7.6): 16 digital and 8 analog inputs, 2 analog outputs, and no node by default.

What it does is up to the nodes that it is given, functions of `(node, pins)`; `leds` and `sample` are two of them.
"""

import functools
from collections.abc import Awaitable, Callable, Mapping

import r2p
from r2p.msg import Float32, Led
from r2p.sim.modules.board import Board, Via

_ADC = 4095  # counts of 12 bits
_REFERENCE = 3.3  # V


class Pins:
    """The module's connectors; what is plugged into them sets the inputs and sees the outputs."""

    def __init__(self) -> None:
        self.digital = [False] * 16
        """Inputs and outputs."""
        self.inputs = [0.0] * 8
        """Voltages at the analog inputs, V."""
        self._outputs = [0, 0]

    @property
    def outputs(self) -> tuple[float, float]:
        """Voltages at the analog outputs, V."""
        one, two = (counts * _REFERENCE / _ADC for counts in self._outputs)
        return one, two

    def read(self, channel: int) -> int:
        """Counts of the A/D converter, 12 bits for 3.3 V."""
        return max(0, min(_ADC, round(self.inputs[channel] / _REFERENCE * _ADC)))

    def write(self, channel: int, counts: int) -> None:
        """Set the D/A converter, 12 bits for 3.3 V."""
        self._outputs[channel] = max(0, min(_ADC, counts))


async def leds(node: r2p.Node, pins: Pins) -> None:
    """Switch the digital outputs as messages on `leds` say."""

    def switch(led: Led) -> None:
        if led.led < len(pins.digital):
            pins.digital[led.led] = bool(led.value)

    node.subscribe("leds", Led, switch)
    while True:
        await node.spin()


async def sample(node: r2p.Node, pins: Pins, channel: int = 0, topic: str = "analog", period: float = 0.1) -> None:
    """Publish the voltage at an analog input, each `period` seconds."""
    voltages = node.advertise(topic, Float32)
    async for _ in node.every(period):
        await voltages.publish(Float32(data=pins.read(channel) * _REFERENCE / _ADC))


class IoModule(Board):
    """The module. `nodes`: functions of `(node, pins)` by name."""

    def __init__(
        self,
        name: str = "IO1",
        *,
        pins: Pins,
        nodes: Mapping[str, Callable[..., Awaitable[object]]] | None = None,
        via: Via = None,
        remap: dict[str, str] | None = None,
    ) -> None:
        self.pins = pins
        programs = {each: functools.partial(function, pins=pins) for each, function in (nodes or {}).items()}
        super().__init__(name, via=via, remap=remap, nodes=programs)
