"""Figures of bags and of sweeps."""
