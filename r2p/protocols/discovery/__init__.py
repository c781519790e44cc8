"""Discovery: the modules of one link find each other, and agree on what flows (PROTOCOL.md 4 and 9).

Read `events` first, which discovery hands to its link; then `interface`, which a link has to it, and which
`r2p.protocols.liveliness` implements as well; then `session`: `Discovery` itself, made of

- `announcer`: this module's announcements, and `schedule`: their repetition;
- `negotiation`: which topics flow to and from which peer;
- `liveness`: modules that join and leave, `directory`: their announcements, and `demand`: what gateways track of them;
- `topic_batch`: announcements that came together, worked out once for all modules of this process.
"""
