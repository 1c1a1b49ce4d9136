"""From a URDF to an FMU."""
