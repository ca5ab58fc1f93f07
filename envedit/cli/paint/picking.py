"""Lights by the rendering: whose highlight or shadow a pixel shows, and where its light must go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from envedit.cli.paint.protocol import Document, Pick, unchanged
from envedit.core import latlong
from envedit.core.arrays import tensor
from envedit.core.rows import Rows
from envedit.representations.layers.oriented import oriented
from envedit.representations.layers.placed_lights import PlacedLights, angles, direction, flux_of
from envedit.scene import placement
from envedit.scene.placement import NoPlaceError
from envedit.scene.scene import Scene
from envedit.transport.light_transport import LightTransport

PLACES = ("illuminate", "rim", "cast")
"""Of what is picked: a light is placed by a click, and not one that shows there dragged."""

PATCH = 1
"""Pixels to each side of a picked one whose rows of T are added: single rows are noisy."""

SAME_LIGHT = np.cos(np.radians(10.0))
"""Cosine of the angle from where a document has a light up to which one of the layers is that light."""


@dataclass(frozen=True)
class Placed:
    """A light as a document has it: direction (3,) in the rotated map, flux (3,), and its entry."""

    direction: np.ndarray
    flux: np.ndarray
    entry: dict[str, Any]


def lights(placed: PlacedLights, document: Document) -> list[Placed]:
    """List the lights of a document: the map's own by their numbers, then added ones (``page/lights.js``)."""
    entries = {entry["light"]: entry for entry in document.lights if "light" in entry}
    own = [entries.get(i + 1, unchanged(i + 1)) for i in range(len(placed.lights))]
    added = [entry for entry in document.lights if "light" not in entry]
    rotation = document.orientation.matrix
    found = []
    for entry in own + added:
        toward, flux = None, flux_of(entry)
        if "light" in entry:
            toward = placed.lights[entry["light"] - 1].direction
            flux = placed.layers.lights.flux[entry["light"] - 1] * flux
        if "azimuth" in entry:
            toward = direction(entry["azimuth"], entry["elevation"])
        found.append(Placed(rotation @ toward, flux, entry))
    return found


def changed(listed: Sequence[Placed], index: int, change: dict[str, Any], document: Document) -> list[dict]:
    """Return the document's entries with a change of one of its listed lights, in the order of the list."""
    entries = [
        light.entry | change if i == index else light.entry
        for i, light in enumerate(listed)
        if i == index or light.entry in document.lights
    ]
    return entries + [entry for entry in document.lights if not any(entry is one.entry for one in listed)]


def index_of(listed: Sequence[Placed], toward: np.ndarray) -> int | None:
    """Return the index of the light that stands in a direction (3,), None where none does."""
    best = max(range(len(listed)), key=lambda i: listed[i].direction @ toward, default=None)
    return best if best is not None and listed[best].direction @ toward > SAME_LIGHT else None


def place(toward: np.ndarray, document: Document) -> dict[str, float]:
    """Return ``azimuth`` and ``elevation`` of an entry of the document whose light is to stand there."""
    azimuth, elevation = angles(toward @ document.orientation.matrix)
    return {"azimuth": azimuth, "elevation": elevation}


class Picking:
    """Answers what was picked on the rendering.

    Of a scene, its transport, the map as it was given, and the rows of it that may change.
    """

    def __init__(self, scene: Scene, placed: PlacedLights, transport: LightTransport, rows: Rows):
        self.scene, self.placed, self.transport, self.rows = scene, placed, transport, rows

    def answer(self, asked: Pick, document: Document, shown: Sequence[Placed]) -> dict[str, Any]:
        """Return ``light``, and where it must stand, or ``text``: why nowhere.

        Without a light one is chosen: that of a highlight adds most at the pixel, that of a shadow has most
        flux of those whose shadow it is in; ``point`` is what casts it. For :data:`PLACES` it is -1, a light
        to be added, but for "cast" that of most flux. ``shown`` are the document's lights where the rendering
        that is shown has them.
        """
        view = min(asked.view, len(self.scene.rows) - 1)
        if asked.of == "cast" and asked.light < 0:
            shining = [i for i in range(len(shown)) if shown[i].flux.any()]
            strongest = max(shining, key=lambda i: shown[i].flux.sum(), default=-1)
            asked = replace(asked, light=strongest)
        if asked.light >= 0 or asked.of in PLACES:
            found: dict[str, Any] = {"light": asked.light}
            try:
                toward = self._direction(asked, view, shown)
            except NoPlaceError as reason:
                return found | {"text": str(reason)}
            row, _ = latlong.texel_position(toward, *self.placed.envmap.shape[:2])
            if not self.rows.first <= round(float(row)) < self.rows.stop:
                return found | {"text": "the light would stand where [input] rows keeps the map"}
            return found | place(toward, document)
        if asked.of == "highlight":
            return {"light": self._lit_by(self.seen(view, asked.x, asked.y), document)}
        return self._shadowed(asked, view, shown)

    def _direction(self, asked, view, shown):
        if asked.of == "illuminate":
            return placement.illuminating(self.scene, view, asked.x, asked.y)
        if asked.of == "rim":
            return placement.rimming(self.scene, view, asked.x, asked.y)
        if asked.of == "cast":
            known = 0 <= asked.light < len(shown)
            light = shown[asked.light].direction if known else None
            return placement.shading(self.scene, view, asked.x, asked.y, light)
        if asked.of == "highlight":
            return placement.highlighting(self.scene, view, asked.x, asked.y)
        if not asked.point:
            raise NoPlaceError("no shadow was picked")
        return placement.shadowing(self.scene, view, asked.x, asked.y, np.array(asked.point))

    def _shadowed(self, asked, view, listed):
        """Return the light of most flux whose shadow lies at a place, and what casts it."""
        text = "the map has no light"
        for i in sorted(range(len(listed)), key=lambda i: -listed[i].flux.sum()):
            if not listed[i].flux.any():
                continue
            try:
                point = placement.occluder(self.scene, view, asked.x, asked.y, listed[i].direction)
                return {"light": i, "point": point.tolist()}
            except NoPlaceError as reason:
                text = f"light {i + 1}: {reason}" if text == "the map has no light" else text
        return {"light": -1, "text": text}

    def seen(self, view: int, x: float, y: float) -> np.ndarray:
        """Return how much light each texel gives to the pixels around a place, (H, W): rows of T."""
        patch = np.zeros((self.scene.height, self.scene.width, 3), np.float32)
        seen = patch[self.scene.rows[view]]
        height, width = seen.shape[:2]
        row, column = min(int(y * height), height - 1), min(int(x * width), width - 1)
        seen[max(row - PATCH, 0) : row + PATCH + 1, max(column - PATCH, 0) : column + PATCH + 1] = 1
        return self.transport.adjoint(tensor(patch)).numpy().mean(axis=2)

    def _lit_by(self, seen, document):
        """Return the index of the light of the document that adds most at a pixel; -1 without lights."""
        best, most = -1, 0.0
        listed = lights(self.placed, document)
        whole = self.placed.place(document.lights)
        for i in range(len(listed)):
            without = self.placed.place(changed(listed, i, {"muted": True}, document))
            lost = oriented(whole - without, document.orientation, []).mean(axis=2)
            share = float((seen * lost).sum())
            if share > most:
                best, most = i, share
        return best
