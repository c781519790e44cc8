"""Two rospy nodes that send 60 bytes there and back, run by Debian's Python.

`rospy_ends.py echo` answers; `rospy_ends.py ping N` prints N round trips in seconds.
"""

import sys
import threading
import time

import rospy
from std_msgs.msg import String


def echo() -> None:
    back = rospy.Publisher("rospy_pong", String, queue_size=10, tcp_nodelay=True)
    rospy.Subscriber("rospy_ping", String, back.publish, tcp_nodelay=True)
    print("ready", flush=True)
    sys.stdin.read()


def ping(rounds: int) -> None:
    came = threading.Event()
    rospy.Subscriber("rospy_pong", String, lambda _message: came.set(), tcp_nodelay=True)
    there = rospy.Publisher("rospy_ping", String, queue_size=10, tcp_nodelay=True)
    message = String("x" * 56)
    while not came.wait(0.1):  # until both are connected
        there.publish(message)
    time.sleep(0.5)
    for _ in range(rounds):
        came.clear()
        at = time.perf_counter()
        there.publish(message)
        came.wait()
        print(time.perf_counter() - at)


if __name__ == "__main__":
    rospy.init_node(sys.argv[1], anonymous=True, disable_signals=True)
    if sys.argv[1] == "echo":
        echo()
    else:
        ping(int(sys.argv[2]))
    rospy.signal_shutdown("done")
