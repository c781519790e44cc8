"""A module: its nodes, its links, and what it knows of the network."""
