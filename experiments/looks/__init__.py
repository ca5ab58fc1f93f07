"""Maps with several lights: which of them moved, and which stayed."""
