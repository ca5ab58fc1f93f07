"""One view of a scene against two: how much of the sky they determine, and how near the map comes."""
