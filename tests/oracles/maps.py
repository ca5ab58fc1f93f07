"""Directions, angles and light of maps, by their definitions."""

import numpy as np

from envedit.core import latlong


def toward(elevation, azimuth):
    """Return the unit vector (3,) of degrees: at azimuth 0 it is -z, at 90 it is +x."""
    e, a = np.radians([elevation, azimuth])
    return np.array([np.cos(e) * np.sin(a), np.sin(e), -np.cos(e) * np.cos(a)])


def angle(d, v):
    """Return the degrees between directions; one of both may be those of a map, (H, W, 3)."""
    return np.degrees(np.arccos(np.clip(d @ v, -1, 1)))


def flux(envmap, where=None):
    """Return the light (3,) of a map, or of a part of it, over the solid angles that Mitsuba looks up."""
    omega = latlong.lookup_solid_angles(*envmap.shape[:2])[:, None, None]
    return (np.float64(envmap) * omega * (1 if where is None else where[..., None])).sum(axis=(0, 1))
