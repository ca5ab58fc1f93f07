"""How a rendering or a map is judged, and the optimiser that follows it."""
