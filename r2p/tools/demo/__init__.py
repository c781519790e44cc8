"""The parts of `r2p demo`."""
