"""Gain maps: many runs of an FMU on one machine or a cluster, and their metrics."""
