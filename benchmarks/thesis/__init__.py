"""The benchmark of RTCAN in the thesis (section 4.4), in virtual time: `python -m benchmarks.rtcan_thesis`."""
