"""The levels of ``envedit run --budget``."""
