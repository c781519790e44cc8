"""Tests that need SocketCAN: they run in one user-mode Linux kernel, beside programs that know nothing of r2p."""
