"""The plant: what also runs inside the FMU, with numpy and Pinocchio and nothing else."""
