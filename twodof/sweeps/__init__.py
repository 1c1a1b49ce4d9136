"""Gain maps: many runs of an FMU, on one machine or on a cluster, and what they tell."""

from .coordinator import sweep
from .design import parse_grids, parse_ranges
from .metrics import METRICS, Metric
from .results import ranked, read_sweep

__all__ = ["METRICS", "Metric", "parse_grids", "parse_ranges", "ranked", "read_sweep", "sweep"]
