"""The runtime: what nodes publish and subscribe with, above the protocols and under the transports.

Read in this order:

    sample        one published message, with its source, stamp and deadline; how one that comes again is recognised
    qos           the classes of publisher, as values that programs give
    backpressure  who waits when a queue or a link is full
    queues        the bounded queues of subscribers, and who is woken first
    topic         what joins publishers, queues and links: `Topic.deliver` is the way of every message
    publishers/   one file for each class of publisher
    subscriber    reading a queue: `async for`, `fetch`, callbacks
    node          what the function of a node gets
    events        what programs can learn of links and modules
"""
