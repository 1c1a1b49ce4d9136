"""ROS 2 bags: written, read, and mended."""
