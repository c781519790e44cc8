"""Transports: bytes <-> samples over real I/O. Each is named by a URL.

What they share, in the order in which to read it:

    link                  what a link is and announces, and what a transport implements (`Transport`) and gets (`Hub`)
    stats                 what is counted
    buffered_link         links with one send buffer and one way in, and who sent what comes in
    receive_backpressure  what becomes of a message that finds a queue full
    line                  the debug line over any carrier of bytes

The transports: `memory`, `tcp`, `serial`, and the packages `rtcan` (on the CAN controllers of `can`) and `zenoh`. `url`
finds a URL's transport.
"""
