"""CAN controllers, each behind the same port. Nothing here knows RTCAN's cycle, laxities or topics.

In the order in which to read it:

    port       what RTCAN needs of a controller; what ports to real interfaces share: life, and mailboxes in software
    socketcan  Linux's CAN interfaces: rawsocket (batches of frames, error frames), netlink (state of the interface)
    pythoncan  the adapters that python-can knows

The simulated controller is in `r2p.sim`.
"""
