"""Emulated R2P modules: peers that behave as those of a robot do, without a board.

    imu = FirmwareModule("IMU1", publishers=[Publishes("leds", Led, period=0.5, fill=blink)])
    async with Powered(imu) as power:
        async with r2p.Module("PC1", via=power.wire()) as module:
            ...

`FirmwareModule` is a module with the firmware of 2014, bytes in and bytes out, with time as an argument. `Powered` runs
it in an event loop, and connects it: by a `wire` inside the process, which virtual time can follow, by TCP, or by a
pseudo terminal that stands in for a serial port.

The hardware modules of the thesis (`MotorModule`, `ProximityModule`, ...) are `r2p.Module`s with nodes around a model
of `r2p.sim.physics`, on any transport; a `Plant` moves the models on. `r2p.sim.robots` makes robots of them.
"""

from r2p.sim.modules.boards import Board, GatewayModule, IoModule, MotorModule, PowerModule, ProximityModule
from r2p.sim.modules.firmware import FirmwareModule, Publishes, Subscribes
from r2p.sim.modules.imu import ImuModule
from r2p.sim.modules.plant import Plant
from r2p.sim.modules.power import Powered, Wire

__all__ = [
    "Board",
    "FirmwareModule",
    "GatewayModule",
    "ImuModule",
    "IoModule",
    "MotorModule",
    "Plant",
    "PowerModule",
    "Powered",
    "ProximityModule",
    "Publishes",
    "Subscribes",
    "Wire",
]
