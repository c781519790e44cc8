"""Simulation: virtual time, a simulated CAN bus, and emulated modules and robots.

    result = r2p.sim.run(main, seed=1)

runs the coroutine function `main` under virtual time: a day of sleeping takes no time, and two runs with the same seed
are the same.

`loop` is virtual time, and `clocks` say how it passes. `transport` puts modules on a simulated bus (`sim:NAME`), which
`can` models bit by bit. `modules` emulates firmware and the hardware modules of the thesis, around the models of
`physics`; `robots` assembles them to a robot.
"""

from r2p.sim.loop import VirtualLoop, run
from r2p.sim.transport import SimCan, can_bus

__all__ = ["SimCan", "VirtualLoop", "can_bus", "run"]
