"""The plant, which also runs inside the FMU; it needs numpy and Pinocchio alone."""
