"""Emulated robots: whole programs of modules and nodes, with a body that moves as the wheels drive it."""
