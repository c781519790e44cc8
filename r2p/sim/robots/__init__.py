"""Emulated robots: modules, nodes, and a body that the wheels drive.

`triskar2` has the nodes of the robot and one that drives it along a square, `emulated` assembles the robot with its
hardware, and `figures` reads its state for displays. `robocom` and `tiltone` are the other robots of the thesis, and
`base` has what all of them share.
"""
