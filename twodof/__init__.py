"""From a URDF to an FMU that every FMI tool loads, from a co-simulation to a ROS 2 bag.

fmu = twodof.build_fmu("TwoDof.fmu")
summary = twodof.simulate(fmu, twodof.Bag("my_bag"), stop_time=5)
"""

# a name is imported on first use: FMPy, rosbags and Pinocchio take a second together
with open(f"{__file__}i", encoding="utf-8") as _stub:
    _HOMES = {line.split()[3]: line.split()[1] for line in _stub if line.startswith("from .")}
__all__ = [*_HOMES]


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    import importlib

    from .errors import TwoDofError

    try:
        return getattr(importlib.import_module(_HOMES[name], __name__), name)
    except TwoDofError as error:  # an extra is missing, which it says when it is used
        missing = error

    def value(*_arguments: object, **_named: object) -> None:
        raise missing

    return value
