"""The plant, which also runs inside the Python FMU; it imports only NumPy and Pinocchio."""
