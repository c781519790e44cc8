"""Emulated R2P modules: peers that behave as the firmware of 2014 does, without a board.

    imu = FirmwareModule("IMU1", publishers=[Publishes("leds", Led, period=0.5, fill=blink)])
    async with Powered(imu) as power:
        async with r2p.Module("PC1", via=power.wire()) as module:
            ...

`FirmwareModule` is the module itself, bytes in and bytes out, with time as an argument. `Powered` runs it in an event
loop, and connects it: by a `wire` inside the process, which virtual time can follow, by TCP, or by a pseudo terminal
that stands in for a serial port.
"""

from r2p.sim.modules.firmware import FirmwareModule, Publishes, Subscribes
from r2p.sim.modules.power import Powered, Wire

__all__ = ["FirmwareModule", "Powered", "Publishes", "Subscribes", "Wire"]
