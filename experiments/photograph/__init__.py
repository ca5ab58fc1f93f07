"""Edits towards photographs of cameras that are not known, against the same pictures given linear."""
