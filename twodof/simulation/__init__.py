"""Experiments and the co-simulation master."""
