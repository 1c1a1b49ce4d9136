"""From a URDF to an FMU that every FMI tool loads, from a co-simulation to a ROS 2 bag."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .bag import Bag, Run, read_bag, recover
    from .build import FmuOptions, build_fmu
    from .errors import TwoDofError
    from .fmu import Fmu, load_fmu
    from .master import RealTime, Sample, Sink, Summary, experiment, samples, simulate
    from .plot import plot_bags
    from .publish import Publisher
    from .sweeps.coordinator import sweep
    from .sweeps.results import read_sweep

# imported on first use: FMPy, rosbags and Pinocchio take a second together
_HOME = {
    "Bag": "bag",
    "Run": "bag",
    "read_bag": "bag",
    "read_sweep": "sweeps.results",
    "recover": "bag",
    "FmuOptions": "build",
    "build_fmu": "build",
    "TwoDofError": "errors",
    "Fmu": "fmu",
    "load_fmu": "fmu",
    "RealTime": "master",
    "Sample": "master",
    "Sink": "master",
    "Summary": "master",
    "experiment": "master",
    "plot_bags": "plot",
    "Publisher": "publish",
    "samples": "master",
    "simulate": "master",
    "sweep": "sweeps.coordinator",
}
__all__ = [
    "Bag",
    "Fmu",
    "FmuOptions",
    "Publisher",
    "RealTime",
    "Run",
    "Sample",
    "Sink",
    "Summary",
    "TwoDofError",
    "build_fmu",
    "experiment",
    "load_fmu",
    "plot_bags",
    "read_bag",
    "read_sweep",
    "recover",
    "samples",
    "simulate",
    "sweep",
]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
