"""The runtime: publishing and subscribing for nodes, above the protocols and under the transports.

Read in this order:

    sample        one published message, with its source, stamp and deadline; filters for duplicates
    qos           the classes of publisher, as values that programs give
    backpressure  who waits when a queue or a link is full
    queues        the bounded queues of subscribers, and who is woken first
    topic         joins publishers, queues and links: `Topic.deliver` is the way of every message
    publishers/   one file for each class of publisher
    subscriber    reading a queue: `async for`, `fetch`, callbacks
    node          the first argument of a node's function
    events        events of links and modules, for programs
"""
