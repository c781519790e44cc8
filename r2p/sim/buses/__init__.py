"""Simulated buses for programs that do not know r2p, by python-can: `can.Bus(interface="r2psim", channel="lab")`."""
