"""ROS 2 messages, topics and DDS transport."""
