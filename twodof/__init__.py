"""From a URDF to an FMU that every FMI tool loads, from a co-simulation to a ROS 2 bag.

fmu = twodof.build_fmu("TwoDof.fmu")
summary = twodof.simulate(fmu, twodof.Bag("my_bag"), stop_time=5)
"""

from __future__ import annotations

from .version import __version__ as __version__

TYPE_CHECKING = False  # that of typing, which would take as long as all else before Ctrl-C is heard
if TYPE_CHECKING:
    from typing import Any

    from .bag.commands import read_commands as read_commands
    from .bag.reader import read_bag as read_bag
    from .bag.recording import Recording as Recording
    from .bag.recovery import recover as recover
    from .bag.writer import Bag as Bag
    from .errors import TwoDofError as TwoDofError
    from .experiments import Experiment as Experiment
    from .experiments import experiment as experiment
    from .export.options import FmuOptions as FmuOptions
    from .export.package import build_fmu as build_fmu
    from .fmu import Fmu as Fmu
    from .fmu import load_fmu as load_fmu
    from .linear import LinearModel as LinearModel
    from .linear import linearise as linearise
    from .master import Summary as Summary
    from .master import samples as samples
    from .master import simulate as simulate
    from .pace import RealTime as RealTime
    from .pages.arm import page as page
    from .pages.live import live as live
    from .pages.replay import view as view
    from .plots.runs import plot as plot
    from .ros.foxglove import Foxglove as Foxglove
    from .ros.layouts import layouts as layouts
    from .ros.publisher import Publisher as Publisher
    from .ros.publisher import publish as publish
    from .ros.publisher import publish_together as publish_together
    from .sample import Sample as Sample
    from .sample import Sink as Sink
    from .sweeps.coordinator import sweep as sweep
    from .sweeps.results import read_sweep as read_sweep

# imported on first use: FMPy, rosbags and Pinocchio take a second together
_HOMES = {
    "bag.commands": ("read_commands",),
    "bag.reader": ("read_bag",),
    "bag.recording": ("Recording",),
    "bag.recovery": ("recover",),
    "bag.writer": ("Bag",),
    "errors": ("TwoDofError",),
    "experiments": ("Experiment", "experiment"),
    "export.options": ("FmuOptions",),
    "export.package": ("build_fmu",),
    "fmu": ("Fmu", "load_fmu"),
    "linear": ("LinearModel", "linearise"),
    "master": ("Summary", "samples", "simulate"),
    "pace": ("RealTime",),
    "pages.arm": ("page",),
    "pages.live": ("live",),
    "pages.replay": ("view",),
    "plots.runs": ("plot",),
    "ros.foxglove": ("Foxglove",),
    "ros.layouts": ("layouts",),
    "ros.publisher": ("Publisher", "publish", "publish_together"),
    "sample": ("Sample", "Sink"),
    "sweeps.coordinator": ("sweep",),
    "sweeps.results": ("read_sweep",),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}
__all__ = [*sorted(_HOME), "__version__"]


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    import importlib

    from .errors import TwoDofError

    try:
        value = getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
    except TwoDofError as error:  # an extra is missing, which it says when it is used
        missing = error

        def value(*_arguments: object, **_named: object) -> None:
            raise missing

    return value
