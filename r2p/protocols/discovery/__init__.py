"""How modules on one link find each other, and agree on what flows (PROTOCOL.md 4 and 9)."""
