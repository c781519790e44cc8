"""Simulation: robots and their time without hardware.

    result = r2p.sim.run(main, seed=1)

runs the coroutine function `main` under virtual time: a day of sleeping takes no time, and two runs with the same seed
are the same.
"""

from r2p.sim.loop import VirtualLoop, run
from r2p.sim.transport import SimCan, can_bus

__all__ = ["SimCan", "VirtualLoop", "can_bus", "run"]
