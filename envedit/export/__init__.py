"""An edit carried to the resolution of the source file."""
