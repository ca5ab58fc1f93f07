"""The command lines: the only part that prints and chooses exit codes."""
