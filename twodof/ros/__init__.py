"""What ROS 2 says and hears, and how."""
