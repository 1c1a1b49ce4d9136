"""Where the links of a URDF are, and what they look like."""
