"""A verdict in words."""

import re
from collections.abc import Mapping
from math import inf

import numpy as np

from .aim import SMALLEST_MOVE
from .cause import FLOOR, MOTION, MOVING, SMALL, Cause, point_text
from .controller_causes import STILL, controller_prefix, payloads
from .judge import AT_LIMIT, Judge

WHOLE = 0.995  # parts above this fraction of the error are not printed: they balance each other
NEXT = "seen when the run is repeated without the first cause"
ADVICE = re.compile(r"; (raise Kp|raise the gains|lower the gains)(, or |(?=$|;))")
"""Advice without a size; a repeated run may have shown that it helps."""
