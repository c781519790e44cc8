"""What r2p costs as a network grows: each figure over the number of modules, topics or clients, and its exponent.

curve           `Curve`: points of a figure over N, and the exponent of their growth
fleet           processes that start at the same time and report their processor time
zenoh_modules   modules in ten processes and one router: until all see all, and at rest
zenoh_network   a large network as one module sees it that joins
tcp_clients     clients of one `tcp-listen:`
gateway_topics  a gateway from CAN and TCP to zenoh, with subscribers that come and go
router_mesh     three zenoh routers in a line, one of which is killed
draw            the picture for the documentation

`python -m benchmarks.growth` runs all of it, or the parts that are named.
"""
