"""`r2p sim`: emulated robots. `command` is the command, `run` runs a robot, and `screen` shows it by its `display`."""
