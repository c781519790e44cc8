"""The parts of `r2p sim` and of `r2p demo`: figures of an emulated robot, how they are shown, and the play itself."""
