"""Layers: lights that move over a background under a smooth gain; the edit instead of the map."""
