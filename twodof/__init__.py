"""From a URDF to an FMU, and from a co-simulation to a ROS 2 bag.

    import twodof

    fmu = twodof.build_fmu("TwoDof.fmu")
    summary = twodof.run(fmu, twodof.Bag("my_bag"), stop_time=5)
    print(summary.error, "m from the target")
    print(twodof.read_bag("my_bag").q[-1], "rad at the end")

Quantities have SI units. Functions accept an FMU's path or the ``Fmu`` that ``load_fmu`` returns.

Build an FMU from a URDF:       build_fmu, FmuOptions, stock_robot, load_fmu, Fmu
Run it:                         run (the same as simulate), experiment, Experiment, Summary, RealTime
Run it step by step:            samples, Sample, Sink
Judge a run:                    verdict, Verdict
Write and read bags:            Bag, read_bag, Recording, export_bag, read_commands, recover
Draw figures and pages:         plot, view, page, live, show
Run it over many gains:         sweep, read_sweep
Check an FMU of any vendor:     check, Check
Fit a robot to its bags:        fit, Fit; excite, Excitation for a motion to record
Linear models:                  linearise, LinearModel
ROS 2 and Foxglove:             publish, publish_together, Publisher, Foxglove, layouts

Errors that a user can correct are subclasses of TwoDofError. The error of a missing extra names it.
"""

from typing import NoReturn

# a name is imported on first use, because FMPy, rosbags and Pinocchio take a second to import
with open(f"{__file__}i", encoding="utf-8") as _stub:
    _HOMES = {line.split()[3]: line.split()[1] for line in _stub if line.startswith("from .")}
__all__ = [*_HOMES]


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        from .errors import choice

        raise AttributeError(f"module '{__name__}' has no attribute '{name}'{choice(name, __all__)}")
    import importlib

    from .errors import TwoDofError
    from .signatures import refusing_unknown

    try:
        public = getattr(importlib.import_module(_HOMES[name], __name__), name)
        return globals().setdefault(name, refusing_unknown(public, name))
    except TwoDofError as error:  # without its extra, a name can be imported, and its use raises this
        missing = error

    def unusable(*_arguments: object, **_named: object) -> NoReturn:
        raise missing

    unusable.__name__, unusable.__doc__ = name, str(missing)
    is_class = name[0].isupper()
    return type(name, (), {"__new__": unusable, "__doc__": str(missing)}) if is_class else unusable
