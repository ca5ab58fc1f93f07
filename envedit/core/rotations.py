"""Rotations of directions, as rotation vectors (the axis times the angle in radians), and of a whole map."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np


def rotation_vector(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the rotation vector that takes one direction to another and keeps what was upright upright.

    About the vertical by the difference in azimuth, then tilted by the difference in elevation.
    """
    frames = []
    for d in (start, end):
        d = np.asarray(d, np.float64) / np.linalg.norm(d)
        level = np.hypot(d[0], d[2])
        east = np.array([-d[2], 0.0, d[0]]) / level if level > 1e-6 else np.array([1.0, 0.0, 0.0])
        frames.append(np.stack([east, np.cross(d, east), d], axis=1))
    r = frames[1] @ frames[0].T
    # Through the quaternion: well defined for half turns too.
    q = np.linalg.eigh(
        np.array(
            [
                [np.trace(r), r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
                [0, r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
                [0, 0, r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
                [0, 0, 0, r[2, 2] - r[0, 0] - r[1, 1]],
            ]
        ),
        UPLO="U",
    )[1][:, -1]
    q = q if q[0] >= 0 else -q
    sine = np.linalg.norm(q[1:])
    return 2 * math.atan2(sine, q[0]) * q[1:] / sine if sine > 1e-12 else np.zeros(3)


def rotated(vector: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Rotate a vector (3,) by a rotation vector (3,): Rodrigues' formula."""
    angle = float(np.linalg.norm(turn))
    if angle < 1e-12:
        return np.array(vector, np.float64)
    axis = np.asarray(turn) / angle
    along = axis * (axis @ vector) * (1 - np.cos(angle))
    return vector * np.cos(angle) + np.cross(axis, vector) * np.sin(angle) + along


def rotation_between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the rotation vector (3,) that brings a unit vector to another by the shortest way."""
    axis = np.cross(start, end)
    sine = float(np.linalg.norm(axis))
    return axis * (np.arctan2(sine, start @ end) / max(sine, 1e-30))


class Orientation(NamedTuple):
    """How a map is rotated as a whole, in degrees.

    In the map's frame (+y up, the middle column towards +z): first ``horizon`` raises the middle of the map,
    then ``tilt`` rotates clockwise about it, both as seen in the map as it is, then ``turn`` about the
    vertical moves the picture to the left (:func:`.latlong.rotate`).
    """

    turn: float = 0.0
    tilt: float = 0.0
    horizon: float = 0.0

    @property
    def level(self) -> bool:
        """Whether it is a turn about the vertical alone, or nothing."""
        return not self.tilt and not self.horizon

    @property
    def matrix(self) -> np.ndarray:
        """Matrix (3, 3) that takes directions of the map to those of the rotated map."""
        matrix = np.eye(3)
        for vector in ((-self.horizon, 0.0, 0.0), (0.0, 0.0, self.tilt), (0.0, self.turn, 0.0)):
            matrix = rotation_matrix(np.radians(vector)) @ matrix
        return matrix


def rotation_matrix(turn: np.ndarray) -> np.ndarray:
    """Return the matrix (3, 3) of a rotation vector (3,)."""
    return np.stack([rotated(axis, turn) for axis in np.eye(3)], axis=1)


def rotation_in(matrix: np.ndarray, rounding: float) -> np.ndarray | None:
    """Return a matrix (3, 3) without its uniform scale; None unless that is a rotation, to ``rounding``."""
    size = np.cbrt(np.linalg.det(matrix)) if np.isfinite(matrix).all() else 0.0
    if not size > 0:
        return None
    rotation = matrix / size
    return rotation if np.abs(rotation @ rotation.T - np.eye(3)).max() <= rounding else None
