"""A picture of the scene under other light as target, against the map that it was rendered under."""
