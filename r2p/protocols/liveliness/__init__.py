"""Discovery by liveliness tokens, on networks that keep them (PROTOCOL.md 10)."""
