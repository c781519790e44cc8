"""Services: a question to another module, and its answer (PROTOCOL.md 9).

Start with `definition`, which turns two message classes into the two topics of a service. Then:

    topics       how each end publishes on one topic, and handles the other's messages as they arrive
    server       requests to handlers: how many run, who waits, who cancels them, what they answer
    answers      what a server remembers, so that a repeated request is handled once
    servers      who serves a service, as the discovery of the links knows it
    client       calls: which server, repetition, time-outs, answers

Nothing here knows a wire: the bytes of requests and answers are those of `r2p.codecs.services`, and what is between the
two modules are topics as any others.
"""
