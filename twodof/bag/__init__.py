"""Write, read and recover ROS 2 bags."""
