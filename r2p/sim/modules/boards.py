"""What the emulated hardware modules share: each is an `r2p.Module` that starts its nodes by itself when it is opened.

The nodes are ordinary ones, around a model of `r2p.sim.physics`; so a board runs on any transport, and can't be told
from a real one by its messages.
"""

import functools
import random
from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import Any, Self

import msgspec

import r2p
from r2p.bridge import BridgeOptions
from r2p.modules.supervisor import NodeFunction
from r2p.msg import Battery as BatteryMessage
from r2p.msg import Encoder, Float32, Led, Proximity, Setpoint
from r2p.sim.physics.motor import Battery, Drive
from r2p.sim.physics.world import RangeFinder, RangeSpec
from r2p.transports.link import Transport

Via = str | Transport | Iterable[str | Transport] | None


class Board(r2p.Module):
    """A hardware module. `nodes`: its node functions by name; more can be started once it is open, as on any module."""

    def __init__(
        self,
        name: str,
        *,
        via: Via = None,
        remap: dict[str, str] | None = None,
        nodes: Mapping[str, NodeFunction] | None = None,
        bridge: bool | BridgeOptions = False,
    ) -> None:
        super().__init__(name, via=via, remap=remap, watchdog=False, bridge=bridge)
        self._programs = dict(nodes or {})

    async def __aenter__(self) -> Self:
        """Power on. Raises as `r2p.Module` does."""
        await super().__aenter__()
        for name, function in self._programs.items():
            self.start(function, name=name)
        return self


# The DC motor controller module (thesis 7.3): subscribes `setpoint`, publishes `encoder` and `current`.


class Setpoints(msgspec.Struct, frozen=True):
    """Where setpoints come from: a topic, its type, and what a message means in ticks or ticks/s."""

    topic: str = "setpoint"
    message: type[r2p.Message] = Setpoint
    ticks: Callable[[Any], float] = lambda message: message.ticks


class MotorConfig(msgspec.Struct, frozen=True, kw_only=True):
    """The node's configuration, as the firmware keeps it in its flash memory."""

    setpoints: Setpoints = Setpoints()
    timeout: float = 0.2
    """Seconds without a setpoint after which the motor stops."""
    encoder: str = "encoder"
    """Topic of the movement in ticks since the message before."""
    period: float = 0.02
    """Of `encoder`, time-triggered, s."""
    current: str = "current"
    """Topic of the motor's current in A."""
    current_period: float = 0.5
    """s."""


async def motor(node: r2p.Node, drive: Drive, config: MotorConfig) -> None:
    """Control the motor."""

    def command(message: r2p.Message) -> None:
        drive.setpoint = config.setpoints.ticks(message)

    source = config.setpoints
    node.subscribe(
        source.topic, source.message, command, queue=1, lossy=True, timeout=config.timeout, on_timeout=drive.stop
    )
    node.advertise(
        config.encoder, Encoder, r2p.Periodic(config.period, lambda: Encoder(delta=float(drive.take_ticks())))
    )
    try:
        while True:
            await node.spin()
    finally:
        drive.stop()


async def monitor(node: r2p.Node, drive: Drive, config: MotorConfig) -> None:
    """Tell the motor's current."""
    current = node.advertise(config.current, Float32)
    async for _ in node.every(config.current_period):
        await current.publish(Float32(data=drive.motor.current))


class MotorModule(Board):
    """The module. `drive` is its hardware: whoever made it moves it on, in a `Plant`."""

    def __init__(
        self,
        name: str = "MOTOR1",
        *,
        drive: Drive,
        config: MotorConfig | None = None,
        via: Via = None,
        remap: dict[str, str] | None = None,
    ) -> None:
        self.drive = drive
        self.config = config or MotorConfig()
        nodes = {
            "motor": functools.partial(motor, drive=drive, config=self.config),
            "monitor": functools.partial(monitor, drive=drive, config=self.config),
        }
        super().__init__(name, via=via, remap=remap, nodes=nodes)


# The proximity module (thesis 7.5): four range finders, published in millimetres on `proximity`.


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


# The input/output module (thesis 7.6): 16 digital and 8 analog inputs, 2 analog outputs, and no node by default.


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


# The power supply module (thesis 7.2): measures voltage and current of the battery, and publishes `battery`.


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


# The gateway module (thesis 7.7): joins the robot's bus to the computers outside, by TCP, serial line or zenoh.


class GatewayModule(Board):
    """The module. `outside`: where computers connect; without any it is a module like others."""

    def __init__(
        self,
        name: str = "GW",
        *,
        via: str | Transport,
        outside: Iterable[str | Transport] = (),
        options: BridgeOptions | None = None,
    ) -> None:
        """Raises as `r2p.Module` does; `options`: what it lets through, by default everything but commands."""
        links = [via, *outside]
        super().__init__(name, via=links, bridge=False if len(links) == 1 else options or True)
