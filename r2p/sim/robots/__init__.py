"""Emulated robots: modules, nodes, and a body that the wheels drive.

`triskar2` has the nodes of the robot, `emulated` assembles it with its hardware; `latest` is what its nodes share,
`square` a node that drives it, and `figures` its state for displays.
"""
