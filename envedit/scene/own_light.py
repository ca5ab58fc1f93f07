"""The light that a scene has of its own and that is no file, as a map."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit.core import installed_plugins, latlong
from envedit.core.color import luminance
from envedit.scene import parser

SPACING_DEGREES = 0.25
"""Most between samples of a light: less than half the sun's disc, so that none lies between them."""
FINER = 48
"""Samples a side in the place of one where neighbours differ by :data:`CONTRAST`: 102 across the sun."""
CONTRAST = 2.0
_MOST_SAMPLES = 2**21  # at a time


@dataclass(frozen=True, eq=False)
class OwnLight:
    """An environment emitter of a parsed scene."""

    plugin: str  # its kind, such as ``sunsky``
    texels: np.ndarray | None  # (H, W, 3), what an ``envmap`` was given in place of a file
    state: mi.parser.ParserState  # a scene of this emitter alone, not built
    where: str  # what errors call the scene

    @classmethod
    def of(cls, state: mi.parser.ParserState, index: int, where: str) -> OwnLight:
        """Take the emitter that is a node of a parsed scene."""
        props = state.nodes[index].props
        texels = None
        if isinstance(bitmap := props.get("bitmap", None), mi.Bitmap):
            texels = np.array(bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, False))
        return cls(props.plugin_name(), texels, _alone(state, index), where)

    def map(self, width: int, to_world: np.ndarray) -> np.ndarray:
        """Return the texels that the emitter was given, or average its radiance over those of a map.

        A map that is made is ``width`` texels wide and half as high; ``to_world`` (3, 3) is the rotation from
        its frame to the scene's. Returned is linear radiance (H, W, 3) float32. InputError if Mitsuba cannot
        evaluate the emitter.
        """
        if self.texels is not None:
            return self.texels
        # ---- The emitter, in a scene that it needs to know its bounds
        installed_plugins.come_first()
        config = mi.parser.ParserConfig(mi.variant())
        emitter = parser.instantiated(config, self.state, self.where).environment()

        def radiance(y, azimuth):
            """Return radiance (..., 3) at heights of unit vectors and azimuths of the map, of one shape."""
            values = np.empty((y.size, 3), np.float32)
            for first in range(0, y.size, _MOST_SAMPLES):
                some = slice(first, first + _MOST_SAMPLES)
                d = latlong.on_sphere(np.arccos(y.ravel()[some]), azimuth.ravel()[some]) @ to_world.T
                si = dr.zeros(mi.SurfaceInteraction3f, len(d))
                si.wi = -mi.Vector3f(*d.T.astype(np.float32))
                values[some] = np.array(parser.called(self.where, emitter.eval, si)).T
            return values.reshape(*y.shape, 3)

        # ---- A grid of samples, several a texel
        height = width // 2
        n = math.ceil(360 / width / SPACING_DEGREES)
        rows = latlong.row_edges(height)
        inside = (rows[:-1, None] + np.diff(rows)[:, None] * np.arange(n) / n).ravel()
        edges = np.cos(np.pi * np.append(inside, 1.0))
        north, step = edges[:-1], np.diff(edges)
        west, across = 2 * np.pi * np.arange(n * width) / (n * width), 2 * np.pi / (n * width)
        samples = radiance(*np.meshgrid(north + step / 2, west + across / 2, indexing="ij"))

        # ---- Finer where neighbours differ: the sun's disc, the horizon
        rows, columns = np.nonzero(_edges(luminance(samples)))
        part = (np.arange(FINER) + 0.5) / FINER
        most = max(1, _MOST_SAMPLES // FINER**2)
        for first in range(0, len(rows), most):
            r, c = rows[first : first + most], columns[first : first + most]
            y = north[r, None, None] + step[r, None, None] * part[:, None]
            azimuth = west[c, None, None] + across * part
            finer = radiance(*np.broadcast_arrays(y, azimuth))
            samples[r, c] = finer.mean(axis=(1, 2), dtype=np.float64)

        # ---- Means over texels, by solid angle
        weight = (step / np.repeat(step.reshape(height, n).sum(axis=1), n))[:, None, None]
        image = (samples * weight).reshape(height, n, width, n, 3).sum(axis=1).mean(axis=2)
        return np.maximum(image, 0).astype(np.float32)  # Mitsuba's fit is negative beside a low sun


def _edges(values):
    """Mark samples (h, w), periodic in w, whose neighbourhood of 3x3 differs by :data:`CONTRAST`."""
    padded = np.pad(np.pad(values, ((0, 0), (1, 1)), mode="wrap"), ((1, 1), (0, 0)), mode="edge")
    around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    return around.max(axis=(2, 3)) > CONTRAST * np.maximum(around.min(axis=(2, 3)), 0)


def _alone(state, index):
    """Return a parsed scene of one node and those that it refers to."""
    taken = [index]
    for i in taken:
        taken += [inner for inner in parser.references(state.nodes[i]).values() if inner not in taken]
    root = mi.parser.SceneNode()
    root.type, root.props = mi.ObjectType.Scene, mi.Properties("scene")
    root.props["light"] = mi.Properties.ResolvedReference(1)
    scene = mi.parser.ParserState()
    scene.nodes.append(root)
    for i in taken:
        node = mi.parser.SceneNode(state.nodes[i])
        for name, inner in parser.references(node).items():
            node.props[name] = mi.Properties.ResolvedReference(1 + taken.index(inner))
        scene.nodes.append(node)
    return scene
