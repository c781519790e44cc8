"""Emulated R2P modules: peers that behave like those of a robot, without a board.

    imu = FirmwareModule("IMU1", publishers=[Publishes("leds", Led, period=0.5, fill=blink)])
    async with Powered(imu) as power:
        async with r2p.Module("PC1", via=power.wire()) as module:
            ...

`firmware` has `FirmwareModule`, a module with the firmware of 2014: bytes in and bytes out, with time as an argument.
`loader` has its loader, for boot mode, `flash` the memory for apps, and `installed` the apps there. `power` has
`Powered`, which runs it in an event loop and connects it: by a `wire` inside the process, which works under virtual
time, by TCP, or by a pseudo terminal in place of a serial port.

`boards` and `sensors` have the hardware modules of the thesis (`MotorModule`, `ProximityModule`, ...): `r2p.Module`s
with nodes around a model of `r2p.sim.physics`, on any transport, and the same loader (`boot`). `Plant` advances the
models. `stamped` has nodes for modules that sample together, and GPS. `r2p.sim.robots` assembles modules to robots.
"""

from r2p.sim.modules.boards import (
    Board,
    GatewayModule,
    IoModule,
    MotorConfig,
    MotorModule,
    ParameterOptions,
    Pins,
    Plant,
    PowerModule,
)
from r2p.sim.modules.firmware import FirmwareModule, Publishes, Subscribes
from r2p.sim.modules.flash import BOARD, FlashTimes, MemoryMap
from r2p.sim.modules.loader import EmulatedLoader, LoaderFaults
from r2p.sim.modules.power import Powered, Wire
from r2p.sim.modules.sensors import (
    ImuModule,
    InertialUnit,
    Motion,
    ProximityModule,
    RangeArray,
    SonarArray,
    SonarModule,
)

__all__ = [
    "BOARD",
    "Board",
    "EmulatedLoader",
    "FirmwareModule",
    "FlashTimes",
    "GatewayModule",
    "ImuModule",
    "InertialUnit",
    "IoModule",
    "LoaderFaults",
    "MemoryMap",
    "Motion",
    "MotorConfig",
    "MotorModule",
    "ParameterOptions",
    "Pins",
    "Plant",
    "PowerModule",
    "Powered",
    "ProximityModule",
    "Publishes",
    "RangeArray",
    "SonarArray",
    "SonarModule",
    "Subscribes",
    "Wire",
]
