"""The DC motor controller module (thesis 7.3): subscribes `setpoint`, publishes `encoder` and `current`.

Closed-loop control of speed or position, in ticks. When no setpoint comes for the configured time, the motor stops.
"""

import functools
from collections.abc import Callable
from typing import Any

import msgspec

import r2p
from r2p.msg import Encoder, Float32, Setpoint
from r2p.sim.modules.board import Board, Via
from r2p.sim.physics.drive import Drive


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
