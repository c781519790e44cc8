"""The hardware modules of the thesis (chapter 7), emulated: motor, input/output, power and gateway; more in `sensors`.

Each is a `Board`, an `r2p.Module` that starts its nodes by itself when it is opened. The nodes are ordinary ones around
a model of `r2p.sim.physics`, so a board runs on any transport, and sends the same messages as a real one. A `Plant`
advances the models.

What firmware has in its configuration are parameters of the nodes: they set the models, at once and at any time.
"""

import asyncio
import contextlib
import functools
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import msgspec

import r2p
from r2p.bridge import BridgeOptions
from r2p.clock import Ticker
from r2p.codecs.management import FLAG_BOOT, FLAG_LOADER, FLAG_REBOOTED
from r2p.modules.supervisor import NodeFunction, NodeOptions
from r2p.msg import Battery, Encoder, Float32, Led, PowerEvent, Setpoint
from r2p.parameters.sources import GivenParameters
from r2p.sim.modules.boot import NODE, BoardBoot
from r2p.sim.physics.motor import Drive, Gains, LeadBattery, Threshold
from r2p.sim.physics.world import ADC_MAX, ADC_REFERENCE, adc_counts
from r2p.transports.link import Transport
from r2p.units import SECOND

Via = str | Transport | Iterable[str | Transport] | None

_CATCH_UP = 1.0  # s of physics to make up for after the loop was blocked; more would hang after a long sleep
_VOLTAGE_COUNT = 36_000 / ADC_MAX  # mV per count: a divider turns 36 V into 3.3 V
_CURRENT_COUNT = 50_000 / ADC_MAX  # mA per count
_SAMPLE = 0.02  # s: the analog watchdog of the power supply compares each sample
_ALERT = 0.05  # s: deadline of its events
_REPEAT = SECOND  # ns between two of them while a threshold is exceeded


class Part(Protocol):
    """Something that changes with time."""

    def step(self, dt: float) -> object:
        """Advance by `dt` seconds."""


class Plant:
    """The clock of the physics: steps its parts in order, every `dt` seconds of the loop's clock, in `async with`."""

    def __init__(self, parts: Iterable[Part] = (), *, dt: float = 0.001) -> None:
        self.parts = list(parts)
        self.dt = dt
        self.steps = 0
        """The number of steps so far."""
        self._ticker: Ticker | None = None

    async def __aenter__(self) -> Self:
        self._ticker = Ticker(asyncio.get_running_loop(), round(self.dt * SECOND), self._tick, background=True)
        self._ticker.start()
        return self

    async def __aexit__(self, *_exception: object) -> None:
        if self._ticker is not None:
            self._ticker.close()

    def step(self, count: int = 1) -> None:
        """Do `count` steps at once."""
        dt, parts = self.dt, self.parts
        for _ in range(count):
            for part in parts:
                part.step(dt)
        self.steps += count

    def _tick(self, _scheduled: int, _late: int, skipped: int) -> None:
        self.step(1 + min(skipped, round(_CATCH_UP / self.dt)))


class ParameterOptions(msgspec.Struct, frozen=True, kw_only=True):
    """What the parameters of boards are at first: `params` of `r2p.Module` by the board's name, and `params_file`."""

    params: Mapping[str, GivenParameters] = {}
    params_file: Path | None = None


class Board(r2p.Module):
    """A hardware module with its node functions by name; more can be started once it is open, as on any module.

    BOOTLOAD ends its nodes and starts the loader of `boot`, until REBOOT. STOP in boot mode makes it deaf to commands,
    and so does an app that can't run, whose start also ends the nodes; `boot.fault` says why.
    """

    def __init__(
        self,
        name: str,
        *,
        via: Via = None,
        remap: dict[str, str] | None = None,
        nodes: Mapping[str, NodeFunction] | None = None,
        bridge: bool | BridgeOptions = False,
        parameters: ParameterOptions | None = None,
    ) -> None:
        given = parameters or ParameterOptions()
        super().__init__(
            name,
            via=via,
            remap=remap,
            watchdog=False,
            bridge=bridge,
            params=given.params.get(name),
            params_file=given.params_file,
        )
        self.boot = BoardBoot()
        """The loader and the apps. Another run of the same hardware gets those of the previous one."""
        self.boot_loader = self.bootload
        self._programs = dict(nodes or {})

    async def __aenter__(self) -> Self:
        """Open the module and start its nodes and apps. Raises as `r2p.Module` does."""
        await super().__aenter__()
        async with contextlib.AsyncExitStack() as opening:
            opening.push_async_exit(self)
            self.boot.fault = ""
            self._opened.set_flags(FLAG_LOADER)
            for name, function in self._programs.items():
                self.start(function, name=name)
            await self._start_apps()
            opening.pop_all()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the module. Raises as `r2p.Module` does."""
        try:
            await self.boot.end()
            self.boot.loader.cut_power(self.space.clock.monotonic())
        finally:
            await super().__aexit__(kind, error, trace)

    async def stop(self) -> None:
        """Stop nodes and apps, as `r2p.Module` does. A board in boot mode ignores all commands from then on."""
        if self.boot.in_boot_mode and not self.boot.fault:
            with contextlib.closing(self._new_node(NODE)) as node:
                self.boot.halt(node, "STOP in boot mode: its management hangs until its power is cut")
        if not self.boot.fault:
            await self.boot.end()
            await super().stop()

    async def bootload(self) -> None:
        """End nodes and apps, and start the loader, anew if it runs. Only `reboot` leaves it.

        Raises Closed if the module is not open.
        """
        tasks = self._running()
        await asyncio.shield(tasks.create_task(self._bootload(), name=f"{self.name} bootload"))

    async def _bootload(self) -> None:
        if not self.boot.fault:
            await self.boot.end()
            await super().stop()
            self.rebooted = True
            self._opened.set_flags(FLAG_REBOOTED | FLAG_BOOT | FLAG_LOADER)
            self.boot.start_loader(self._new_node)

    async def _reboot(self) -> None:
        if not self.boot.fault:
            await self.boot.end()
            await super()._reboot()
            if self._open:
                self._opened.set_flags(self._opened.flags | FLAG_LOADER)
                await self._start_apps()

    async def _start_apps(self) -> None:
        self.boot.start_apps(self._new_node)
        if self.boot.fault:
            await self.boot.end()
            await super().stop()

    def _new_node(self, name: str) -> r2p.Node:
        return self._make_node(name, NodeOptions())


class Closes(Protocol):
    """A publisher or a subscriber."""

    def close(self) -> None:
        """Close it."""


def reopens(open: Callable[[float], Closes]) -> Callable[[float], None]:
    """Return a function that opens something with a value, and then closes what it opened with the value before."""
    opened: Closes | None = None

    def reopen(value: float) -> None:
        nonlocal opened
        before, opened = opened, open(value)
        if before is not None:
            before.close()

    return reopen


async def paced(node: r2p.Node, period: r2p.Parameter[float]) -> AsyncIterator[r2p.Tick]:
    """Iterate over ticks as `Node.every` does; a new period counts from the next tick on."""
    while True:
        seconds = period.value
        async for tick in node.every(seconds):
            yield tick
            if period.value != seconds:
                break


def quantity(
    node: r2p.Node,
    name: str,
    default: float,
    limits: tuple[float, float],
    unit: str,
    doc: str,
    on_change: Callable[[float], object] | None = None,
) -> r2p.Parameter[float]:
    """Declare a parameter with a unit. A default beyond the limits, which the maker of a board chose, moves them."""
    low, high = min(limits[0], default), max(limits[1], default)
    return node.parameter(name, default, min=low, max=high, unit=unit, doc=doc, on_change=on_change)


class MotorConfig(msgspec.Struct, frozen=True, kw_only=True):
    """The configuration of the motor module; times are what its parameters are at first."""

    setpoint: str = "setpoint"
    """Topic of the setpoints."""
    message: type[r2p.Message] = Setpoint
    """Their type."""
    ticks: Callable[[Any], float] = lambda message: message.ticks
    """Converts such a message to the setpoint of the drive: ticks/s or ticks, or V or Nm, whatever its mode is."""
    timeout: float = 0.2
    """Seconds without a setpoint after which the motor stops."""
    encoder: str = "encoder"
    """Topic of the movement in ticks since the previous message; none if another node publishes it."""
    period: float = 0.02
    """Period of `encoder`, time-triggered, s."""
    current: str = "current"
    """Topic of the motor's current in A."""
    current_period: float = 0.5
    """s."""


def tune(node: r2p.Node, drive: Drive) -> None:
    """Let the parameters of a node set gains and limits of a drive."""
    if drive.mode in ("speed", "position"):
        _tune_control(node, drive)
    elif drive.mode == "voltage":

        def clip(volts: float) -> None:
            drive.pid.gains = Gains(0.0, limit=volts)

        limit = drive.gains.limit
        clip(quantity(node, "voltage_limit", limit, (0.0, 36.0), "V", "Highest voltage at the motor", clip).value)

    def chop(amperes: float) -> None:
        drive.motor.current_limit = amperes

    most = drive.motor.spec.current_limit
    doc = "The bridge chops a higher current, which limits the torque"
    chop(quantity(node, "current_limit", most, (0.0, 20.0), "A", doc, chop).value)


def _tune_control(node: r2p.Node, drive: Drive) -> None:
    """Declare the gains of a closed loop. Its angles are in ticks, those of the parameters of the wheel."""
    ticks, gains = drive.motor.spec.ticks_per_radian, drive.gains
    units = ("V/(rad/s)", "V/rad", "V/(rad/s^2)") if drive.mode == "speed" else ("V/rad", "V/(rad s)", "V/(rad/s)")

    def gain(name: str, default: float, most: float, unit: str, doc: str) -> r2p.Parameter[float]:
        return quantity(node, name, float(f"{default * ticks:.6g}"), (0.0, most), unit, doc, control)

    def control(_value: float) -> None:
        drive.pid.gains = Gains(kp.value / ticks, ki.value / ticks, kd.value / ticks, limit.value)

    kp = gain("kp", gains.kp, 100.0, units[0], "Proportional gain of the control of the wheel")
    ki = gain("ki", gains.ki, 10_000.0, units[1], "Its integral gain; with 0 the wheel stays behind")
    kd = gain("kd", gains.kd, 10.0, units[2], "Its derivative gain, of what is measured")
    limit = quantity(node, "voltage_limit", gains.limit, (0.0, 36.0), "V", "Highest voltage at the motor", control)
    control(kp.value)


async def motor(node: r2p.Node, drive: Drive, config: MotorConfig) -> None:
    """Control the motor: the node of the DC motor controller module."""
    tune(node, drive)

    def command(message: r2p.Message) -> None:
        drive.setpoint = config.ticks(message)

    def moved() -> Encoder:
        return Encoder(delta=float(drive.take_ticks()))

    # Only the newest setpoint counts: a late one must not delay it.
    listen = reopens(
        lambda timeout: node.subscribe(
            config.setpoint, config.message, command, queue=1, lossy=True, timeout=timeout, on_timeout=drive.stop
        )
    )
    measure = reopens(lambda period: node.advertise(config.encoder, Encoder, r2p.Periodic(period, moved)))
    doc = "The motor stops when no setpoint has arrived for so long"
    listen(quantity(node, "timeout", config.timeout, (0.02, 10.0), "s", doc, listen).value)
    if config.encoder:
        doc = "Period of the encoder's messages"
        measure(quantity(node, "encoder_period", config.period, (0.005, 0.1), "s", doc, measure).value)
    try:
        while True:
            await node.spin()
    finally:
        drive.stop()


async def monitor(node: r2p.Node, drive: Drive, config: MotorConfig) -> None:
    """Publish the motor's current."""
    period = quantity(node, "period", config.current_period, (0.01, 10.0), "s", "Period of the measurements")
    current = node.advertise(config.current, Float32)
    async for _ in paced(node, period):
        await current.publish(Float32(data=drive.motor.current))


class MotorModule(Board):
    """The DC motor controller module (thesis 7.3): subscribes `setpoint`, publishes `encoder` and `current`.

    `drive` is its hardware, which the caller steps in a `Plant`.
    """

    def __init__(
        self,
        name: str = "MOTOR1",
        *,
        drive: Drive,
        config: MotorConfig | None = None,
        via: Via = None,
        remap: dict[str, str] | None = None,
        parameters: ParameterOptions | None = None,
    ) -> None:
        config = config or MotorConfig()
        nodes = {
            "motor": functools.partial(motor, drive=drive, config=config),
            "monitor": functools.partial(monitor, drive=drive, config=config),
        }
        super().__init__(name, via=via, remap=remap, parameters=parameters, nodes=nodes)


class Pins:
    """The module's connectors: external hardware sets the inputs and reads the outputs."""

    def __init__(self) -> None:
        self.digital = [False] * 16
        """Inputs and outputs."""
        self.inputs = [0.0] * 8
        """Voltages at the analog inputs, V."""
        self._outputs = [0, 0]

    @property
    def outputs(self) -> tuple[float, float]:
        """Voltages at the analog outputs, V."""
        one, two = (counts * ADC_REFERENCE / ADC_MAX for counts in self._outputs)
        return one, two

    def read(self, channel: int) -> int:
        """Return the counts of the A/D converter, 12 bits for 3.3 V."""
        return adc_counts(self.inputs[channel])

    def write(self, channel: int, counts: int) -> None:
        """Set the counts of the D/A converter, 12 bits for 3.3 V."""
        self._outputs[channel] = max(0, min(ADC_MAX, counts))


async def leds(node: r2p.Node, pins: Pins) -> None:
    """Switch the digital outputs as commanded on `leds`."""

    def switch(led: Led) -> None:
        if led.led < len(pins.digital):
            pins.digital[led.led] = bool(led.value)

    node.subscribe("leds", Led, switch)
    while True:
        await node.spin()


async def sample(node: r2p.Node, pins: Pins, channel: int = 0, topic: str = "analog", period: float = 0.1) -> None:
    """Publish the voltage at an analog input every `period` seconds."""
    voltages = node.advertise(topic, Float32)
    async for _ in node.every(period):
        await voltages.publish(Float32(data=pins.read(channel) * ADC_REFERENCE / ADC_MAX))


class IoModule(Board):
    """The input/output module (thesis 7.6): 16 digital inputs and outputs, 8 analog inputs, 2 analog outputs.

    `nodes`: functions of `(node, pins)` by name; by default it has none.
    """

    def __init__(
        self,
        name: str = "IO1",
        *,
        pins: Pins,
        nodes: Mapping[str, Callable[..., Awaitable[object]]] | None = None,
        via: Via = None,
        remap: dict[str, str] | None = None,
        parameters: ParameterOptions | None = None,
    ) -> None:
        programs = {each: functools.partial(function, pins=pins) for each, function in (nodes or {}).items()}
        super().__init__(name, via=via, remap=remap, parameters=parameters, nodes=programs)


def measured(battery: LeadBattery) -> Battery:
    """Return the readings of the A/D converter, with a resolution of 9 mV and 12 mA; the charge is not calibrated."""
    return Battery(
        voltage=round(round(battery.voltage * 1000 / _VOLTAGE_COUNT) * _VOLTAGE_COUNT),
        current=max(-32768, min(32767, round(round(battery.current * 1000 / _CURRENT_COUNT) * _CURRENT_COUNT))),
        charge=255,
        remaining=65535,
    )


async def power(node: r2p.Node, battery: LeadBattery, topic: str, period: float) -> None:
    """Publish the measurements."""
    each = quantity(node, "period", period, (0.01, 10.0), "s", "Period of the measurements")
    measurements = node.advertise(topic, Battery)
    async for _ in paced(node, each):
        await measurements.publish(measured(battery))


async def limits(node: r2p.Node, battery: LeadBattery, topic: str) -> None:
    """Publish an event when voltage or current crosses a threshold: the analog watchdog of the power supply.

    While one is exceeded, the event is repeated, for those that came later: firmware has no latched topics.
    """
    voltage, current = _thresholds(node)
    events = node.advertise(topic, PowerEvent, r2p.Sporadic(deadline=_ALERT), latch=True)
    repeat_at = 0
    async for tick in node.every(_SAMPLE):
        now = measured(battery)
        crossed = sum(bit for bit, each in voltage.items() if each.update(now.voltage / 1000))
        crossed += sum(bit for bit, each in current.items() if each.update(now.current / 1000))
        exceeded = sum(bit for bit, each in (voltage | current).items() if each.exceeded)
        if crossed or (exceeded and tick.due >= repeat_at):
            repeat_at = tick.due + _REPEAT
            await events.publish(PowerEvent(crossed, exceeded, now.voltage, now.current))


def _thresholds(node: r2p.Node) -> tuple[dict[int, Threshold], dict[int, Threshold]]:
    """Declare the thresholds of voltage and current, and return them by their bits in a PowerEvent."""
    low, high, most = Threshold("below"), Threshold("above"), Threshold("above")

    def change(_value: float) -> None:
        low.level, high.level, most.level = low_voltage.value, high_voltage.value, high_current.value
        low.hysteresis = high.hysteresis = voltage_hysteresis.value
        most.hysteresis = current_hysteresis.value

    def threshold(name: str, default: float, highest: float, unit: str, doc: str) -> r2p.Parameter[float]:
        return quantity(node, name, default, (0.0, highest), unit, doc, change)

    def ordered(hysteresis: float, values: Mapping[str, Any]) -> str | None:
        below = values["low_voltage"] + hysteresis < values["high_voltage"]
        return None if below else "low_voltage and voltage_hysteresis together have to be below high_voltage"

    low_voltage = threshold("low_voltage", 23.0, 36.0, "V", "An event when the voltage falls below it")
    high_voltage = threshold("high_voltage", 29.0, 36.0, "V", "An event when the voltage rises above it")
    voltage_hysteresis = node.parameter(
        "voltage_hysteresis",
        0.5,
        min=0.0,
        max=5.0,
        unit="V",
        doc="How far the voltage has to return for the event to end",
        check=ordered,
        on_change=change,
    )
    high_current = threshold("high_current", 30.0, 50.0, "A", "An event when the current rises above it")
    current_hysteresis = threshold(
        "current_hysteresis", 2.0, 20.0, "A", "How far the current has to return for the event to end"
    )
    change(0.0)
    return {PowerEvent.LOW_VOLTAGE: low, PowerEvent.HIGH_VOLTAGE: high}, {PowerEvent.HIGH_CURRENT: most}


class PowerModule(Board):
    """The power supply module (thesis 7.2): measures voltage and current of the battery, and publishes `battery`.

    An event on `power_event` says that one of them crossed a threshold. The caller steps `battery` in a `Plant`.
    """

    def __init__(
        self,
        name: str = "PS",
        *,
        battery: LeadBattery,
        topic: str = "battery",
        period: float = 0.5,
        via: Via = None,
        remap: dict[str, str] | None = None,
        parameters: ParameterOptions | None = None,
    ) -> None:
        """`period` in seconds."""
        nodes = {
            "power": functools.partial(power, battery=battery, topic=topic, period=period),
            "limits": functools.partial(limits, battery=battery, topic="power_event"),
        }
        super().__init__(name, via=via, remap=remap, parameters=parameters, nodes=nodes)


class GatewayModule(Board):
    """The gateway module (thesis 7.7): joins the robot's bus to computers by TCP, serial line or zenoh.

    `outside`: the links for computers; without any it is an ordinary module.
    """

    def __init__(
        self,
        name: str = "GW",
        *,
        via: str | Transport,
        outside: Iterable[str | Transport] = (),
        options: BridgeOptions | None = None,
        parameters: ParameterOptions | None = None,
    ) -> None:
        """`options`: rules for forwarding, by default everything but commands. Raises as `r2p.Module` does."""
        links = [via, *outside]
        super().__init__(name, via=links, bridge=len(links) > 1 and (options or True), parameters=parameters)
