"""RTCAN: real-time publish/subscribe on a CAN bus, as state machines (thesis chapter 4, PROTOCOL.md 6 to 9).

`engine.Engine` is the door; its module says how to drive it. Behind it, each rule has its own file:

    laxity       which soft or non real-time message is tried next
    calendar     which slots belong to whom, at the master
    leases       asking for slots, granting them, losing them
    periodic     the node's own calendar: what to do in which slot
    cycle        slots and cycles by the sync frames, network time
    sending      the mailboxes, in slots or without
    reassembly   frames to messages, and what was lost
    identity     claiming an id8
    election     who becomes the master
    network      finding, following and being the master
    profile      RTCAN or firmware of 2014
    topics       high bytes for topics
"""
