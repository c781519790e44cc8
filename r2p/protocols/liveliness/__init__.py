"""Discovery by liveliness tokens, on networks that keep them (PROTOCOL.md 10).

session    `LivelinessDiscovery`: what a link uses in place of `Discovery`, and the tokens that it had no room for
tokens     what this module has, as tokens
matching   which topics flow between this module and each other session
modules    the other modules and their nodes
"""
