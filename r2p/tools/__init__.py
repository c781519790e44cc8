"""The `r2p` command. Only the public API; each group of commands is a module of its own, imported when it is called."""
