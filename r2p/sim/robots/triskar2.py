"""Triskar2, the omnidirectional robot of thesis 8.1: its nodes.

    velocity_cmd -> obstacle -> velocity -> invkin -> speed -> three motor modules
                        ^                     ^                       |
                    proximity              encoders  <----------------+--> fwdkin -> odometry

They use only the public API, so each of them runs on any module, of this robot or another one:

    r2p run r2p.sim.robots.triskar2:inverse_kinematics=invkin --via rtcan:can0

A node of the chain keeps the newest message of each input (`Latest`), and sends its output (`sender`): periodically if
it is hard real-time, otherwise with each new input. `square` is a node for a PC, which drives the robot.

`r2p.sim.robots.emulated` puts the whole robot together, with its modules and its body.
"""

import functools
import math
from collections.abc import Callable
from typing import Generic, Literal, TypeVar

import r2p
from r2p.msg import Battery, Encoder, Odometry, Pose3, Proximity, Speed3, Velocity3
from r2p.sim.physics.motor import BatterySpec, MotorSpec
from r2p.sim.physics.world import OmniSpec, Triple

M = TypeVar("M", bound=r2p.Message)
Traffic = Literal["hrt", "srt", "nrt"]
"""The class of the chain's messages: hard real-time (`Periodic`), soft real-time (`Sporadic`), non real-time."""

BODY = OmniSpec()
MOTOR = MotorSpec()
BATTERY = BatterySpec()

PERIOD = 0.02
"""Period of speeds and encoders, s; of the whole command chain if all of it is hard real-time."""
COMMANDS = 0.05
"""Period of velocity commands, s."""
FRESH = 0.15
"""Seconds for which a message of the chain is used."""
TIMEOUT = 0.2
"""Seconds without a setpoint after which a motor stops."""

WHEELS = 3
SIDES = {"prox_front": 0.0, "prox_rear": 180.0}
"""Topics of the two proximity modules, and their directions, degrees from ahead."""
BEARINGS = (67.5, 22.5, -22.5, -67.5)
"""Directions of the four sensors of each module, degrees from there."""

REST = 0.5
"""Seconds that a robot rests at each corner of the square."""
DIRECTIONS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
"""Directions of the square's sides, in the robot's frame."""

_DEADLINE = 0.05  # s, of soft real-time messages
_AHEAD = math.cos(math.radians(60))
_BACKLOG = 250  # encoder readings, five seconds: a lost one would distort the odometry
_ROUNDS = 5  # encoder readings per message of odometry: 10 Hz, thesis table 4.1


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
        self._fresh = round(fresh * 1e9)
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


async def obstacle_avoidance(node: r2p.Node, traffic: Traffic = "srt") -> None:
    """Forward `velocity_cmd` as `velocity`; if an obstacle is in the way, only its rotation.

    If a proximity module is silent, the robot does not move in its direction.
    """
    stop = node.parameter(
        "stop_distance",
        0.15,
        min=0.0,
        max=0.8,
        unit="m",
        doc="Distance to an obstacle at which the robot stops when it is slow",
    )
    braking = node.parameter(
        "braking_time",
        0.4,
        min=0.0,
        max=2.0,
        unit="s",
        doc="The faster, the earlier: the distance grows by what it drives in this time",
    )
    sides = {angle: Latest(node, topic, Proximity, fresh=2 * FRESH) for topic, angle in SIDES.items()}

    def blocked(command: Velocity3) -> bool:
        speed = math.hypot(command.x, command.y)
        for angle, latest in sides.items():
            ranges = latest.message.ranges if latest.message else (0, 0, 0, 0)
            for bearing, reading in zip(BEARINGS, ranges, strict=True):
                at = math.radians(angle + bearing)
                towards = command.x * math.cos(at) + command.y * math.sin(at)
                if towards > _AHEAD * speed and reading / 1000 < stop.value + braking.value * towards:
                    return True
        return False

    def velocity() -> Velocity3 | None:
        command = commands.message
        if command is None or not blocked(command):
            return command
        return Velocity3(w=command.w)

    send = sender(node, "velocity", Velocity3, velocity, traffic=traffic, period=PERIOD)
    commands = Latest(node, "velocity_cmd", Velocity3, fresh=FRESH, changed=send)
    while True:
        await node.spin()


async def inverse_kinematics(node: r2p.Node, traffic: Traffic = "hrt") -> None:
    """Convert `velocity` to speeds of the wheels (`speed`, rad/s); all wheels stop while one of them is silent."""
    wheels = [Latest(node, f"encoder{wheel + 1}", Encoder, fresh=FRESH) for wheel in range(WHEELS)]

    def speeds() -> Speed3 | None:
        velocity = velocities.message
        if velocity is None:
            return None
        if any(wheel.message is None for wheel in wheels):
            return Speed3()
        return Speed3(value=BODY.wheel_speeds(velocity.x, velocity.y, velocity.w))

    send = sender(node, "speed", Speed3, speeds, traffic=traffic, period=PERIOD)
    velocities = Latest(node, "velocity", Velocity3, fresh=FRESH, changed=send)
    while True:
        await node.spin()


async def forward_kinematics(
    node: r2p.Node,
    body_velocity: Callable[..., Triple] = BODY.body_velocity,
    wheels: int = WHEELS,
    motor: MotorSpec = MOTOR,
    encoder_period: float = PERIOD,
    rounds: int = _ROUNDS,
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
    pose = Pose3()
    x = y = w = 0.0  # moved since the last message, in the frame of the robot
    done = 0
    while True:
        await node.spin()
        if not all(readings):
            continue
        # All wheels together: one alone would seem to turn the robot.
        dx, dy, dw = body_velocity(*turned)
        heading = pose.w + dw / 2
        cos, sin = math.cos(heading), math.sin(heading)
        pose = Pose3(pose.x + dx * cos - dy * sin, pose.y + dx * sin + dy * cos, pose.w + dw)
        x, y, w, done = x + dx, y + dy, w + dw, done + max(readings)
        turned[:], readings[:] = [0.0] * wheels, [0] * wheels
        if done >= rounds:
            span = done * period.value
            odometry.publish_nowait(Odometry(pose, Velocity3(x / span, y / span, w / span)))
            x = y = w = 0.0
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


async def square(
    node: r2p.Node,
    side: float = 1.0,
    speed: float = 0.5,
    laps: float = math.inf,
    traffic: Traffic = "srt",
    wait: float = 1.0,
) -> None:
    """Publish `velocity_cmd`: after `wait` seconds drive `laps` squares, and then stand still.

    It drives by the clock, not by odometry, so that command and position can be compared.
    """
    start = node.now()
    leg = side / speed + REST  # s

    def command() -> Velocity3:
        elapsed = (node.now() - start) / 1e9 - wait
        number, within = divmod(elapsed, leg)
        if not 0 <= elapsed < laps * len(DIRECTIONS) * leg or within >= side / speed:
            return Velocity3()
        x, y = DIRECTIONS[int(number) % len(DIRECTIONS)]
        return Velocity3(x=speed * x, y=speed * y)

    send = sender(node, "velocity_cmd", Velocity3, command, traffic=traffic, period=PERIOD)
    async for _ in node.every(COMMANDS):
        send()
