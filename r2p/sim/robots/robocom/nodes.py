"""Robocom's nodes (thesis figure 8.5), and one for a PC that drives it in circles.

    velocity -> invkin -> speed -> two motor modules -> encoder_left, encoder_right -> fwdkin -> odometry

They use only the public API, so each of them runs on any module. The nodes that sample encoders, inertial sensors and
GPS are those of the modules (`r2p.sim.modules.stamped`); the battery monitor is in `r2p.sim.robots.shared_nodes`.
"""

import math

import r2p
from r2p.msg import Speed2, StampedEncoder, StampedOdometry, Timestamp, Velocity3
from r2p.sim.physics.differential import DifferentialSpec
from r2p.sim.physics.motor import BatterySpec, MotorSpec
from r2p.sim.robots.shared_nodes import COMMANDS, FRESH, DeadReckoning, Latest
from r2p.units import SECOND

BODY = DifferentialSpec()
MOTOR = MotorSpec(
    resistance=0.3,
    torque_constant=30.2,
    rotor_inertia=142.0,
    gear=74.0,
    friction=700.0,
    damping=50.0,
    current_limit=6.0,
)
"""150 W, 74:1, 2000 ticks/turn (thesis 8.2.1); the rest as of a usual motor of that power, with its rated current."""
BATTERY = BatterySpec(capacity=21.0, resistance=30.0)
"""Six lead batteries, together 24 V and 21 Ah (thesis 8.2.1)."""

ENCODERS = ("encoder_left", "encoder_right")
"""Topics of the encoders: StampedEncoder, in ticks."""
PERIOD = 0.02
"""Period of speeds and encoders, s."""
IMU_PERIOD = 0.02
"""Of the raw readings of the IMU, s."""

_ROUNDS = 5  # pairs of encoder readings per message of odometry: 10 Hz
_STAMPS = 64  # readings of one wheel that wait for those of the other


async def inverse_kinematics(node: r2p.Node, body: DifferentialSpec = BODY) -> None:
    """Convert `velocity` to speeds of the wheels (`speed`, rad/s), without jumps: the robot is heavy.

    Without a fresh command it brakes to a halt. While a wheel is silent, both are stopped at once.
    """
    ramp = node.parameter("acceleration", 0.6, min=0.05, max=3.0, unit="m/s^2", doc="How fast its speed changes")
    turn_ramp = node.parameter(
        "turn_acceleration", 2.0, min=0.1, max=10.0, unit="rad/s^2", doc="How fast its rate of turn changes"
    )
    fastest = node.parameter(
        "max_speed", 1.0, min=0.1, max=1.2, unit="m/s", doc="Highest speed of a wheel on the ground"
    )
    wheels = [Latest(node, topic, StampedEncoder, fresh=FRESH) for topic in ENCODERS]
    velocities = Latest(node, "velocity", Velocity3, fresh=FRESH)
    x = w = 0.0

    def speeds() -> Speed2 | None:
        nonlocal x, w
        if any(wheel.message is None for wheel in wheels):
            x = w = 0.0
            return Speed2()
        command = velocities.message
        wanted = Velocity3() if command is None else command
        outer = abs(wanted.x) + abs(wanted.w) * body.track / 2
        share = min(1.0, fastest.value / outer) if outer else 1.0  # of both, so that the curve stays the same
        x = _towards(x, wanted.x * share, ramp.value * PERIOD)
        w = _towards(w, wanted.w * share, turn_ramp.value * PERIOD)
        return Speed2(value=body.wheel_speeds(x, w))

    node.advertise("speed", Speed2, r2p.Periodic(PERIOD, speeds))
    while True:
        await node.spin()


def _towards(value: float, wanted: float, most: float) -> float:
    return value + max(-most, min(most, wanted - value))


class _Wheel:
    """The way of one wheel until each of its last samples."""

    def __init__(self) -> None:
        self._turned = 0.0
        self.until: dict[tuple[int, int], float] = {}  # seconds and ns of the stamp: ticks

    def add(self, encoder: StampedEncoder) -> None:
        self._turned += encoder.delta
        self.until[encoder.timestamp.sec, encoder.timestamp.nsec] = self._turned
        if len(self.until) > _STAMPS:
            del self.until[next(iter(self.until))]

    def take(self, stamp: tuple[int, int]) -> float:
        """Return the way until a sample, and forget this and older ones."""
        turned = self.until[stamp]
        for each in list(self.until):
            del self.until[each]
            if each == stamp:
                break
        return turned


async def forward_kinematics(node: r2p.Node, body: DifferentialSpec = BODY, motor: MotorSpec = MOTOR) -> None:
    """Compute `odometry` from both encoders: the pose since the node started, and the velocity, with their time.

    Only samples of one instant count together. It pauses while a wheel is silent.
    """
    odometry = node.advertise("odometry", StampedOdometry, r2p.Sporadic(deadline=_ROUNDS * PERIOD))
    left, right = _Wheel(), _Wheel()
    for topic, wheel in zip(ENCODERS, (left, right), strict=True):
        node.subscribe(topic, StampedEncoder, wheel.add, queue=250)  # a lost one would distort the odometry
    reckoning = DeadReckoning()
    before, begun, rounds = (0.0, 0.0), 0, 0
    while True:
        await node.spin()
        for stamp in [each for each in left.until if each in right.until]:
            now = left.take(stamp) / motor.ticks_per_radian, right.take(stamp) / motor.ticks_per_radian
            reckoning.move(*body.body_velocity(now[0] - before[0], now[1] - before[1]))
            before, rounds = now, rounds + 1
            if rounds < _ROUNDS:
                continue
            time = Timestamp(*stamp)
            span = (time.ns - begun) / SECOND
            velocity = reckoning.velocity(span or PERIOD)
            if begun and span > 0:  # not if the network's time began anew
                odometry.publish_nowait(StampedOdometry(time, reckoning.pose, velocity))
            begun, rounds = time.ns, 0


async def eight(
    node: r2p.Node, speed: float = 0.6, radius: float = 3.0, rounds: float = math.inf, wait: float = 1.0
) -> None:
    """Publish `velocity`: after `wait` seconds drive a figure of eight `rounds` times, and then stand still."""
    start = node.now()
    circle = math.tau * radius / speed  # s
    commands = node.advertise("velocity", Velocity3, r2p.Sporadic(deadline=COMMANDS))
    async for _ in node.every(COMMANDS):
        circles = ((node.now() - start) / SECOND - wait) / circle
        if not 0 <= circles < 2 * rounds:
            await commands.publish(Velocity3())
        else:
            way = 1 if int(circles) % 2 == 0 else -1
            await commands.publish(Velocity3(x=speed, w=way * speed / radius))
