"""Maps without a scene: what is done with the file of a map alone."""
