"""Build an FMU from a URDF."""
