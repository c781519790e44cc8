"""Transports: bytes <-> samples over real I/O. Each is named by a URL.

Shared code, in the order in which to read it:

    link                  a link and its announcements; the interfaces of transports (`Transport`) and modules (`Hub`)
    stats                 the counters
    buffered_link         links with one send buffer and one way in, and the senders of their messages
    receive_backpressure  the wait of a received message for room in a queue
    line                  the debug line over any carrier of bytes

The transports: `memory`, `tcp`, `serial`, and the packages `rtcan` (on the CAN controllers of `can`) and `zenoh`. `url`
finds a URL's transport.
"""
