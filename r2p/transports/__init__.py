"""Transports: bytes <-> samples over real I/O. Each is named by a URL.

What they share, in the order in which to read it:

    link                  what a link is, and what a transport implements (`Transport`) and gets (`Hub`)
    announcement, stats   what the other ends know of a topic; what is counted
    buffered_link         links with one send buffer and one way in
    receive_backpressure  what becomes of a message that finds a queue full
    senders               who sent what comes in
    line                  the debug line over any carrier of bytes

The transports: `memory`, `tcp`, `serial`, and the packages `rtcan` (on the CAN controllers of `can`) and `zenoh`. `url`
finds a URL's transport.
"""
