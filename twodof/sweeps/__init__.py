"""Gain maps: many runs of an FMU, on one machine or on a cluster, and what they tell."""
