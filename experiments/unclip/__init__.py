"""Maps whose sun is clipped, and given back."""
