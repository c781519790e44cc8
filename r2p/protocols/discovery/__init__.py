"""Discovery: the modules of one link find each other, and agree on what flows (PROTOCOL.md 4 and 9).

Read `events` first, which discovery hands to its link; then `session`: `DiscoveryProtocol`, the interface that a link
has to it, which `r2p.protocols.liveliness` implements as well, and `Discovery` itself, made of

- `announcer`: this module's announcements, and `schedule`: their repetition;
- `negotiation`: which topics flow to and from which peer;
- `liveness`: modules that join and leave, and `directory`: their announcements, also for gateways.
"""
