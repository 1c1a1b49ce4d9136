"""Tables of sweeps, read by an independent reader of Parquet."""

import sys
from pathlib import Path

import duckdb
import pandas

COMMAND = [sys.executable, "-m", "twodof"]
SMALL = {"Kp": (20.0, 60.0, 180.0), "Kd": (8.0, 30.0)}
BEGUN = """
import os, signal
with open(os.environ['BEGUN'], 'a') as file:
    file.write(f'{self.Kp[0]:g} ')
if self.Kp[0] % 300 == 0:
    os.kill(os.getpid(), signal.SIGKILL)
"""
"""Before a step: tells which runs are begun, and kills the process of some."""


def table_of(path: Path) -> pandas.DataFrame:
    """A sweep's table, read from its files by another reader of Parquet."""
    return duckdb.execute(f"select * from '{path}/*.parquet'").df()


def same(found: pandas.DataFrame, expected: pandas.DataFrame) -> None:
    """Compare tables exactly, row by row; a sweep's table is a subclass of DataFrame."""
    pandas.testing.assert_frame_equal(found, expected, check_exact=True, check_dtype=False, check_frame_type=False)
