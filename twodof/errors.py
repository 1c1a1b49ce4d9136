"""Exceptions of the package: one root, named leaves; each message is one clear line."""

from __future__ import annotations

import zipfile
import zlib

ZIP_ERRORS = (OSError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError)
"""Exceptions of a damaged, encrypted or foreign zip archive."""


class TwoDofError(Exception):
    """Root of all errors caused by a user's input or machine."""


class BuildError(TwoDofError):
    """The FMU cannot be built because of the URDF, its meshes, an option or the compiler."""


class FmuError(TwoDofError):
    """The file is not an FMU that this master can run."""


class InputError(TwoDofError):
    """A setting, an input file or a time of the run is invalid."""


class SimulationError(TwoDofError):
    """The FMU refused or failed a call, or returned a value that is not finite.

    Attributes:
        k: number of communication steps that were done.
        outcome: "discarded" (fmi2Discard), "diverged" (not finite) or "failed" (all else).
    """

    def __init__(self, message: str, k: int = 0, outcome: str = "failed") -> None:
        super().__init__(message)
        self.k, self.outcome = k, outcome


class BagError(TwoDofError):
    """A bag cannot be written or read."""


class SweepError(TwoDofError):
    """A sweep cannot be run, stored or read because of its workers, Dask or the folder."""


class ChildError(TwoDofError):
    """A child process failed with an unexpected exception."""


class PlotError(TwoDofError):
    """A bag cannot be drawn because of matplotlib, the robot, its joints or the output file."""


class PageError(TwoDofError):
    """A page cannot be shown because of its port, the robot or the output file."""


class PublishError(TwoDofError):
    """A run cannot be published because of Cyclone DDS, the network or a ROS 2 variable."""


def diverged(k: int, t: float) -> SimulationError:
    """Return the error of a sample that is not finite, after k steps, at a time."""
    return SimulationError(f"the FMU gave a value that is not finite at t = {t:g} s", k, "diverged")


def step_failure(k: int, t: float, error: SimulationError) -> SimulationError:
    """Return the error of a failed step, after k steps, at a time."""
    return SimulationError(f"step {k + 1} at t = {t:g} s: {error}", k, error.outcome)
