"""Drive a robot by keys: w, a, s, d move it, q and e turn it, all others stop it.

When this program ends, or the cable is pulled, commands stop coming and the robot stops by itself. In two terminals:
r2p sim triskar2 --via tcp-listen:2323
r2p run teleop.py:keys --via tcp:127.0.0.1:2323
"""

import contextlib
import os
import select
import sys
from collections.abc import Iterator

import r2p
from r2p.msg import Odometry, Velocity3

SPEED, TURN = 0.3, 0.8  # m/s, rad/s
MOVES = {"w": Velocity3(x=SPEED), "s": Velocity3(x=-SPEED), "a": Velocity3(y=SPEED), "d": Velocity3(y=-SPEED)}
MOVES |= {"q": Velocity3(w=TURN), "e": Velocity3(w=-TURN)}


@contextlib.contextmanager
def single_keys() -> Iterator[None]:
    """At a terminal: each key at once, without Return."""
    import termios
    import tty

    before = termios.tcgetattr(sys.stdin) if sys.stdin.isatty() else None
    try:
        if before is not None:
            tty.setcbreak(sys.stdin)
        yield
    finally:
        print()  # else the shell's prompt would follow the robot's place
        if before is not None:
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)


def typed() -> str:
    """Return what was typed since the last call."""
    ready, _, _ = select.select([sys.stdin], [], [], 0)
    return os.read(sys.stdin.fileno(), 100).decode(errors="ignore") if ready else ""


def show(odometry: Odometry) -> None:
    pose = odometry.pose
    print(f"\rx {pose.x:6.2f} m   y {pose.y:6.2f} m   heading {pose.w:6.2f} rad ", end="", flush=True)


async def keys(node: r2p.Node) -> None:
    commands = node.advertise("velocity_cmd", Velocity3, r2p.Sporadic(deadline=0.05))
    odometry = node.subscribe("odometry", Odometry, show, queue=1, lossy=True)
    command = Velocity3()
    print("w, a, s, d: move    q, e: turn    any other key: stop")
    with single_keys():
        async for _ in node.every(0.05):
            for key in typed():
                command = MOVES.get(key, Velocity3())
            await commands.publish(command)
            await odometry.serve()
