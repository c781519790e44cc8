"""Discovery by liveliness tokens, on networks that keep them (PROTOCOL.md 10).

session    `LivelinessDiscovery`, in place of `Discovery`, and tokens without room
tokens     this module's tokens, and the topics that flow between it and each other session
packing    the keys that carry this module's tokens, several each
modules    the other modules and their nodes
"""
