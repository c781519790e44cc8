"""CAN controllers, each behind the same port. Nothing here knows RTCAN's cycle, laxities or topics.

In the order in which to read it:

    port       the interface of a controller to RTCAN; the common part of real ones: life, and mailboxes in software
    socketcan  Linux's CAN interfaces: rawsocket (batches of frames, error frames), netlink (state of the interface)
    pythoncan  the adapters of python-can
    sending    the same interfaces for recordings that are played: frames of all kinds go out as they are

The simulated controller is in `r2p.sim`.
"""
