"""ROS 2 bags: the sink that writes them, what reads them back, and what mends them."""

from .reader import Run, TopicCount, read_bag, read_ends
from .recovery import Recovered, recover
from .writer import Bag

__all__ = ["Bag", "Recovered", "Run", "TopicCount", "read_bag", "read_ends", "recover"]
