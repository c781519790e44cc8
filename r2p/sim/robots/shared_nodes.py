"""What the nodes of several robots share: inputs and outputs of a control chain, odometry, and the battery monitor.

A node of a chain keeps the newest message of each input (`Latest`), and sends its output (`sender`): periodically if it
is hard real-time, otherwise with each new input. All of it uses only the public API.
"""

import functools
import math
from collections.abc import Callable
from typing import Generic, Literal, TypeVar

import r2p
from r2p.msg import Battery, Encoder, Odometry, Pose3, Velocity3
from r2p.sim.physics.motor import BatterySpec, MotorSpec
from r2p.sim.physics.world import Triple
from r2p.units import SECOND

M = TypeVar("M", bound=r2p.Message)
Traffic = Literal["hrt", "srt", "nrt"]
"""The class of a chain's messages: hard real-time (`Periodic`), soft real-time (`Sporadic`), non real-time."""

BATTERY = BatterySpec()
"""That of most robots."""

COMMANDS = 0.05
"""Period of velocity commands, s."""
FRESH = 0.15
"""Seconds for which a message of a chain is used."""
TIMEOUT = 0.2
"""Seconds without a setpoint after which a motor stops."""

_DEADLINE = 0.05  # s, of soft real-time messages
_BACKLOG = 250  # encoder readings, five seconds: a lost one would distort the odometry


class Latest(Generic[M]):
    """The newest message of a topic, while it is fresh; `changed` is called for each, in the node's task."""

    def __init__(
        self,
        node: r2p.Node,
        topic: str,
        type: type[M],
        *,
        fresh: float,
        changed: Callable[[], object] = lambda: None,
    ) -> None:
        """`fresh` in seconds. The node has to `spin()`."""
        self._node = node
        self._fresh = round(fresh * SECOND)
        self._changed = changed
        self._message: M | None = None
        self.received = 0
        """UTC at which the newest message arrived, ns."""
        node.subscribe(topic, type, self._received, queue=1, lossy=True)

    @property
    def message(self) -> M | None:
        """The newest message; None if it is not fresh."""
        return self._message if self._node.now() - self.received <= self._fresh else None

    def _received(self, message: M) -> None:
        self._message = message
        self.received = self._node.now()
        self._changed()


def sender(
    node: r2p.Node,
    topic: str,
    type: type[M],
    fill: Callable[[], M | None],
    *,
    traffic: Traffic,
    period: float,
    deadline: float = _DEADLINE,
) -> Callable[[], object]:
    """Publish the result of `fill`, None for nothing: every `period` seconds ("hrt"), or when the result is called.

    `deadline` in s, of soft real-time messages.
    """
    if traffic == "hrt":
        node.advertise(topic, type, r2p.Periodic(period, fill))
        return lambda: None
    publisher = (
        node.advertise(topic, type, r2p.Sporadic(deadline=deadline))
        if traffic == "srt"
        else node.advertise(topic, type)
    )

    def send() -> None:
        message = fill()
        if message is not None:
            publisher.publish_nowait(message)

    return send


class DeadReckoning:
    """The pose of a robot, from its small movements since the node started."""

    def __init__(self) -> None:
        self.pose = Pose3()
        self._x = self._y = self._w = 0.0  # moved since the last velocity, in the frame of the robot

    def move(self, x: float, y: float, w: float) -> None:
        """Add a movement in the frame of the robot, m and rad: along the heading in its middle."""
        pose = self.pose
        heading = pose.w + w / 2
        cos, sin = math.cos(heading), math.sin(heading)
        self.pose = Pose3(pose.x + x * cos - y * sin, pose.y + x * sin + y * cos, pose.w + w)
        self._x, self._y, self._w = self._x + x, self._y + y, self._w + w

    def velocity(self, seconds: float) -> Velocity3:
        """Return the mean velocity since the last call, which was so many seconds ago."""
        mean = Velocity3(self._x / seconds, self._y / seconds, self._w / seconds)
        self._x = self._y = self._w = 0.0
        return mean


async def forward_kinematics(
    node: r2p.Node,
    body_velocity: Callable[..., Triple],
    *,
    wheels: int,
    motor: MotorSpec,
    encoder_period: float,
    rounds: int,
) -> None:
    """Compute `odometry` from the encoders of all wheels: the pose since the node started, and the velocity.

    `body_velocity` is the kinematics of the robot: what so many wheels make it do. One message is of so many `rounds`
    of readings. It pauses while a wheel is silent; the readings of the others count as soon as that is back.
    """
    period = node.parameter(
        "encoder_period",
        encoder_period,
        min=0.005,
        max=0.1,
        unit="s",
        doc="Period of the encoders' messages, as the motor modules have it",
    )
    odometry = node.advertise("odometry", Odometry, r2p.Sporadic(deadline=rounds * encoder_period))
    turned, readings = [0.0] * wheels, [0] * wheels

    def turn(wheel: int, encoder: Encoder) -> None:
        turned[wheel] += encoder.delta / motor.ticks_per_radian
        readings[wheel] += 1

    for wheel in range(wheels):
        node.subscribe(f"encoder{wheel + 1}", Encoder, functools.partial(turn, wheel), queue=_BACKLOG)
    reckoning = DeadReckoning()
    done = 0
    while True:
        await node.spin()
        if not all(readings):
            continue
        reckoning.move(*body_velocity(*turned))  # of all wheels together: one alone would seem to turn the robot
        done += max(readings)
        turned[:], readings[:] = [0.0] * wheels, [0] * wheels
        if done >= rounds:
            odometry.publish_nowait(Odometry(reckoning.pose, reckoning.velocity(done * period.value)))
            done = 0


async def battery_monitor(node: r2p.Node, spec: BatterySpec = BATTERY) -> None:
    """Estimate the charge (`battery`) from voltage and current (`power`); warn once when it is low."""
    low = node.parameter("low_charge", 20, min=0, max=100, unit="%", doc="A lower charge of the battery is a warning")
    battery = node.advertise("battery", Battery, latch=True)
    current: float | None = None  # A, the mean of the last ten seconds or so
    warned = False
    async for reading in node.subscribe("power", Battery, lossy=True):
        rest = reading.voltage + reading.current * spec.resistance / 1000  # mV without a load
        share = (rest / 1000 - spec.empty) / (spec.full - spec.empty)
        charge = max(0, min(100, round(share * 100)))
        now = reading.current / 1000
        current = now if current is None else current + (now - current) / 20
        hours = spec.capacity * charge / 100 / current if current > 0 else math.inf
        await battery.publish(Battery(reading.voltage, reading.current, charge, round(min(65535, hours * 60))))
        if charge < low.value and not warned:
            node.log.warning("battery is down to %d %%: %.1f V", charge, reading.voltage / 1000)
        warned = charge < low.value
