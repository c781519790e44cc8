"""Discovery: the modules of one link find each other, and agree on what flows (PROTOCOL.md 4 and 9).

Read `events` first, what discovery hands to its link; then `session`: `DiscoveryProtocol`, the interface that a link
has to it, which `r2p.protocols.liveliness` implements as well, and `Discovery` itself, made of

- `announcer`: what this module says, and `schedule`: when it says it again;
- `negotiation`: which topics flow to and from which peer;
- `liveness`: which modules come and go, and `directory`: what they have said, and what gateways need to know of it.
"""
