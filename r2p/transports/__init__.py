"""Transports: bytes <-> samples over real I/O. Each is named by a URL; `url.open_transport` finds its class."""
