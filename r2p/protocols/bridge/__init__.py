"""Spanning tree: gateways agree on one, so that no message goes round or arrives twice.

CAN and debug frames carry no sequence number, so nothing can repair the effects of a loop: there must not be one, not
even while messages of gateways are lost, late, doubled or out of order. A spanning tree protocol does not promise that
while it converges. Here every gateway knows the whole mesh of gateways, and computes the same tree from it; a port
forwards only while every gateway that was heard on its network has acknowledged the very same mesh within a lease. A
gateway that sees another mesh is silent, and thereby silences its neighbours. So along any loop all gateways that
forward do so by one and the same tree, which has no loop.

Messages of an old tree must be gone before a gateway forwards under a new one: hence the pause `SETTLE` between
agreement and forwarding. It is longer than a message may take from its publisher to the last gateway.

Read `mesh` first (which gateways hear each other, and their tree), then `ports` (one port: timings, acknowledgements,
its state) and `tree` (all ports of one gateway, and its clients). `link_selection` is the same from the side of modules
with several links.
"""
