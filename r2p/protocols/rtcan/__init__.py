"""RTCAN: real-time publish/subscribe on a CAN bus, as state machines (thesis chapter 4, PROTOCOL.md 6 to 9).

Begin with `engine`: `Engine` is one node, its docstring says how to drive it, and `Engine._update_mode` decides whether
and how the node may send. Then, in this order:

    events      the settings and actions of an engine, and the state shared by its parts
    node_id     claiming an id8
    network     finding and following a network; master: the election, and being the master
    management  the management messages of the bus
    cycle       slots and cycles by the sync frames, network time
    leases      periodic messages: requests, grants and the plan of slots; calendar: the reserved slots
    transmitter the order of frames; queue: soft and non real-time messages by laxity
    reassembly  frames to messages, and losses
    topic_ids   high bytes for topics
    monitor     watching a bus without sending, for tools

The layout of identifiers is in `r2p.codecs.rtcan`, the length of frames in `r2p.codecs.can_bits`.
"""
