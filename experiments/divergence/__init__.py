"""Why Adam on a path-traced environment map diverges, and the same on stored transport."""
