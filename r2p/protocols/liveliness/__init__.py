"""Discovery by liveliness tokens, on networks that keep them (PROTOCOL.md 10).

session    `LivelinessDiscovery`: what a link uses in place of `Discovery`, and the tokens that it had no room for
tokens     what this module has, as tokens, and which topics flow between it and each other session
modules    the other modules and their nodes
"""
