"""RTCAN on a CAN bus (PROTOCOL.md 6 to 9): `rtcan:can0` on SocketCAN, `rtcan:INTERFACE:CHANNEL` by python-can.

The protocol itself is the engine in `r2p.protocols.rtcan`, which does no I/O; the controllers are in
`r2p.transports.can`. This package joins both, and makes a link of them. In the order in which to read it:

    transport    the options of a URL, the port, and the life of the link
    driver       the loop that drives the engine: feed it, act on what it returns, re-arm one timer; UTC of the network
    link         the link of a module on a bus, and its texts for users
    message_ids  the message ids to receive, and the topics behind them
    bus_topics   what is on the bus, published for subscribers anywhere in the network
    tx           messages on their way out: in slots of their own, or by their deadlines
"""
