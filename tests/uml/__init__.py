"""SocketCAN without hardware, root or kernel modules: a Linux kernel that runs as a process (user-mode Linux)."""
