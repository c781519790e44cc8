"""RTCAN as a transport: one engine, and the ports that carry its frames."""
