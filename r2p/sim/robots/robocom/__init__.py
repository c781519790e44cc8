"""Robocom, the heavy robot on two wheels for research in sensor fusion (thesis 8.2).

`nodes` has its nodes, `robot` assembles it with its hardware, and `joystick` drives it by hand.
"""
