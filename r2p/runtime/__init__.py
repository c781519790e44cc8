"""The runtime: publishing and subscribing for nodes, above the protocols and under the transports.

Read in this order:

    sample        one published message, with its source, stamp and deadline; filters for duplicates
    qos           the classes of publisher, as values that programs give
    backpressure  waiting for room in a full queue or link
    queues        the bounded queues of subscribers, and the order of waking them
    topic         joins publishers, queues and links: `Topic.deliver` is the way of every message
    immediate     subscriptions without a queue, whose messages are handled at once
    publishers/   one file for each class of publisher
    subscriber    reading a queue: `async for`, `fetch`, callbacks
    node          the first argument of a node's function
    events        events of links and modules, for programs
"""
