"""The bounds of `r2p.analysis` beside what the simulated bus does: `python -m benchmarks.analysis`."""
