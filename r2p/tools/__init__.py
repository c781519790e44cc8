"""The `r2p` command: only the public API."""
