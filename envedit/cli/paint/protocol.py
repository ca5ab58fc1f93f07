"""What page and server say to each other: JSON messages from the page, JSON and frames to it.

A frame is 16 bytes and half floats, little-endian: "EVPF", kind (:data:`KINDS`), source (:data:`SOURCES`),
width and height as uint16, number as uint32, view (an index) as uint16; then RGB, row by row.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from typing import Any

import numpy as np

from envedit.config.input_schema import Target
from envedit.config.method_schema import Solve
from envedit.config.schema import FIELDS
from envedit.config.validators import (
    Choice,
    Integer,
    Number,
    Numbers,
    String,
    WantedError,
    show,
)
from envedit.core.errors import ConfigError
from envedit.core.rotations import Orientation

MOST_BYTES = 1 << 20
"""Length of a message from the page."""
MOST_STROKES, MOST_POINTS = 500, 20_000
"""Of a document: what is more would take seconds to paint."""
KINDS = (
    "render", "map", "difference", "unreachable", "before", "explanation", "sky", "sky-before", "photograph",
)  # fmt: skip
ORIENTATION = ("rotate_degrees", "tilt_degrees", "horizon_degrees")
"""Keys of ``[input]`` that a document has, in the order of :class:`.Orientation`."""
SOURCES = ("transport", "mitsuba", "saved")
PHASES = ("drawing", "dragging", "done")
"""A stroke is being drawn, a light is being dragged, or neither."""
_LARGEST = 65504.0


def unchanged(number: int | None) -> dict[str, Any]:
    """Return the entry of a light of the map, by its number, that is as the map has it."""
    return {"light": number, "flux": [1.0] * 3, "size": 1.0}


class BadMessageError(ValueError):
    """A message that is refused; the text says why."""


@dataclass(frozen=True)
class Document:
    """What a user has done: all that is saved, keys of a configuration (:data:`TABLES`)."""

    strokes: tuple[dict, ...] = ()
    lights: tuple[dict, ...] = ()
    regions: tuple[dict, ...] = ()
    rotate_degrees: float = 0.0
    tilt_degrees: float = 0.0
    horizon_degrees: float = 0.0
    exposure: float = 0.0
    temperature: float = 0.0
    rest: str = Target.rest
    freedom: float = Solve.freedom

    @property
    def placing(self) -> tuple:
        """What decides what the map is before paint: not the names and roles of its lights."""
        labels = "name", "role"
        lights = [{k: v for k, v in light.items() if k not in labels} for light in self.lights]
        placed = [light for light in lights if light != unchanged(light.get("light"))]
        return placed, self.regions, self.orientation

    def solved_as(self, other: Document) -> bool:
        """Whether another document has the same solution, which may be adjusted otherwise."""
        same = (getattr(self, name) == getattr(other, name) for name in ("strokes", "rest", "freedom"))
        return all(same) and self.placing == other.placing

    @property
    def orientation(self) -> Orientation:
        """How the map is rotated as a whole, after its lights are placed."""
        return Orientation(self.rotate_degrees, self.tilt_degrees, self.horizon_degrees)

    def plain(self) -> dict:
        """Return it as JSON has it."""
        return {name: getattr(self, name) for name in TABLES}


TABLES = {
    "strokes": "target",
    "lights": "input",
    "regions": "input",
    **dict.fromkeys(ORIENTATION, "input"),
    "exposure": "output",
    "temperature": "output",
    "rest": "target",
    "freedom": "solve",
}
"""Keys of a document, and which table of a configuration has them."""


def document(value: Any) -> Document:
    """Read a document; raises BadMessageError."""
    if not isinstance(value, dict) or not value.keys() <= TABLES.keys():
        raise BadMessageError(f"document: got {show(value)[:80]}, expected keys among {', '.join(TABLES)}")
    _check_counts(value.get("strokes"))
    found: dict[str, Any] = {}
    for name, given in value.items():
        try:
            found[name] = FIELDS[TABLES[name]][name].metadata["check"](given)
        except ConfigError as error:
            raise BadMessageError(str(error)) from None
        except WantedError as error:
            raise BadMessageError(f"document.{name}: got {show(given)[:80]}, expected {error}") from None
    return Document(**found)


def _check_counts(strokes):
    """Refuse more strokes or points than are painted, before each of them is checked."""
    if not isinstance(strokes, list | tuple):
        return
    tables = [stroke for stroke in strokes if isinstance(stroke, dict)]
    lists = [table.get(key) for table in tables for key in ("points", "polygon")]
    points = sum(len(one) for one in lists if isinstance(one, list | tuple))
    if len(strokes) > MOST_STROKES or points > MOST_POINTS:
        raise BadMessageError(
            f"document: got {len(strokes)} strokes of {points} points, expected at most {MOST_STROKES} "
            f"of {MOST_POINTS}"
        )


@dataclass(frozen=True)
class Edit:
    """The document as it is now, which edit of whose it is, and whether it is still being made.

    ``painting`` is the number of the ``opened`` message that it belongs to; 0: of the one that is open.
    """

    document: Document
    phase: str = "done"
    client: str = ""
    number: int = 0
    painting: int = 0


PICKED = ("highlight", "shadow", "illuminate", "rim", "cast", "shares")


@dataclass(frozen=True)
class Pick:
    """A place on the rendering of a view (shares of width and height) that a light is dragged from, or to.

    ``light`` is the index of the light that follows, in the order of the ``lights`` message; -1: the server
    chooses. ``of`` is what is dragged, a "highlight" or a "shadow", and ``point`` what casts the shadow; or
    what the light is placed to do, to "illuminate", to "rim" or to "cast" a shadow there; or "shares" of
    light are asked for.
    """

    x: float
    y: float
    light: int = -1
    number: int = 0
    client: str = ""
    view: int = 0
    of: str = "highlight"
    point: tuple[float, ...] = ()


@dataclass(frozen=True)
class Open:
    """A scene or configuration, and a map in place of its own ("" for that)."""

    name: str
    envmap: str = ""


@dataclass(frozen=True)
class Choose:
    """Go on from another explanation of the paint: its index in the last ``explanations`` message."""

    explanation: int


@dataclass(frozen=True)
class ApplyLook:
    """Paint on, on the map in the light of a look: the name and text of its file (:mod:`.looks`)."""

    name: str
    text: str


@dataclass(frozen=True)
class Sky:
    """Show the map large, as edited and as it was given."""


@dataclass(frozen=True)
class Save:
    """Write the results."""


MESSAGES = {
    "document": Edit, "pick": Pick, "open": Open, "choose": Choose, "look": ApplyLook, "sky": Sky,
    "save": Save,
}  # fmt: skip
"""Types of messages from the page, and what they become."""
_CHECKS: dict[str, Callable[[Any], Any]] = {
    "document": document,
    "phase": Choice(*PHASES),
    "x": Number(0, 1),
    "y": Number(0, 1),
    "light": Integer(-1, 100),
    "of": Choice(*PICKED),
    "point": Numbers(*3 * [Number(-1e30, 1e30)]),
    "name": String(least=1),
    "envmap": String(),
    "text": String(),
    **dict.fromkeys(("number", "painting", "view", "explanation"), Integer(0, 2**53)),
}
"""Their keys."""


def read(text: str | bytes, client: str = "") -> Any:
    """Read a message from the page: an instance of one of the classes in :data:`MESSAGES`.

    BadMessageError if it is not JSON, of no known type, or has unusable values.
    """
    if isinstance(text, bytes) or len(text) > MOST_BYTES:
        raise BadMessageError(f"got {len(text)} bytes, expected JSON text of at most {MOST_BYTES}")
    try:
        found = json.loads(text, parse_constant=_refused)
    except (ValueError, RecursionError):
        raise BadMessageError("got something else, expected JSON") from None
    kind = found.get("type") if isinstance(found, dict) else None
    if not isinstance(kind, str) or kind not in MESSAGES:
        raise BadMessageError(f"type: got {show(kind)[:80]}, expected one of {', '.join(MESSAGES)}")
    values: dict[str, Any] = {}
    for key in fields(MESSAGES[kind]):
        if key.name == "client":
            values[key.name] = client
        elif key.name in found or key.default is MISSING:
            try:
                values[key.name] = _CHECKS[key.name](found.get(key.name))
            except WantedError as error:
                raise BadMessageError(f"{kind}: expected {error}") from None
    return MESSAGES[kind](**values)


def _refused(name):
    raise ValueError(name)


def frame(kind: str, source: str, count: int, image: np.ndarray, view: int = 0) -> bytes:
    """Return an image (h, w, 3) as a frame; what is beyond half floats is cut at their largest."""
    height, width, _ = image.shape
    head = struct.pack(
        "<4sBBHHIH", b"EVPF", KINDS.index(kind), SOURCES.index(source), width, height, count % 2**32, view
    )
    pixels = np.nan_to_num(image, nan=0.0, posinf=_LARGEST, neginf=-_LARGEST)
    return head + np.clip(pixels, -_LARGEST, _LARGEST).astype("<f2").tobytes()
