"""What an FMU is to do, and the master that has it done."""
