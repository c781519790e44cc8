"""Emulated robots: modules, nodes, and a body that the wheels drive.

`triskar2` has the nodes of Triskar2 and one that drives it along a square, and `emulated` assembles that robot with its
hardware. `robocom` and `tiltone` are the other robots of the thesis, and `hexapod` has 20 modules. `base` and
`shared_nodes` have what robots share, and `figures` reads their state for displays.
"""
