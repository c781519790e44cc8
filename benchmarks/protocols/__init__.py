"""RTCAN beside other protocols on the same simulated bus: the study that docs/comparison.md shows."""
