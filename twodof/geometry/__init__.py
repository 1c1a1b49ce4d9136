"""Poses and shapes of the links of a URDF."""
