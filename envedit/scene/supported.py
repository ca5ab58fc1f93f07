"""What of a parsed Mitsuba scene is used, what is left out, and what is refused by name.

``docs/scenes.md`` lists every plugin, checked by ``tests/oracle/test_supported_scenes.py``. Each function
takes the parser's ``state`` and ``where``, what errors call the scene.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from envedit.core import shipped
from envedit.core.errors import ConfigError, InputError
from envedit.scene import parser
from envedit.scene.own_light import OwnLight

SENSORS = ("perspective", "thinlens", "orthographic")
"""Sensors whose rays make a picture; others are refused."""
PATHS = ("path", "prb", "prb_basic", "prb_projective", "ptracer")
"""Integrators of surfaces, of any path depth."""
DIRECT = ("direct", "direct_projective")
"""Integrators of direct light alone, which are paths of two segments."""
VOLUMES = ("volpath", "volpathmis", "prbvolpath")
"""Integrators that would follow light through media."""
WRAPPERS = ("aov", "moment", "stokes")
"""Integrators that render by another one inside."""
ROULETTE = 5
"""Path length from which on Mitsuba ends paths by Russian roulette, where the integrator names none."""
POLARISING = ("circular", "measured_polarized", "polarizer", "pplastic", "retarder")
"""Materials that are there for polarised light."""

_ROUNDING = 1e-3  # of a rotation's columns that a file gives with few digits


@dataclass(frozen=True)
class OwnMap:
    """The light that a scene's environment emitter gives."""

    # The map's file, which need not exist; None where the emitter is no ``envmap`` or names none
    file: Path | None
    scale: float  # what any map is multiplied by, above 0
    notes: tuple[str, ...] = ()  # what the user should know
    light: OwnLight | None = None  # the emitter, where it names no file
    # Why the scene has neither, as an error says it; "" of a scene that is made for any map
    missing: str = ""
    added: bool = False  # the scene has no environment emitter: the map is light beside its own


PLACEHOLDER = "placeholder"
"""The id of a ``constant`` emitter that stands for any map and is no light of its own."""
_GIVE_MAP = "or give a map to light it: --envmap FILE, or [input] envmap"


def own_map(
    state: mi.parser.ParserState, where: str, folders: Iterable[Path], scale: float | str = "auto"
) -> OwnMap:
    """Read what the scene's environment emitter gives, before it is replaced.

    ``scale`` takes the place of the emitter's. InputError if there are several emitters, or the emitter's own
    scale is not a finite number above 0.
    """
    # ---- No emitter, or one that is no map
    factor = 1.0 if isinstance(scale, str) else scale
    index = parser.environment(state, where)
    if index is None:
        emitter = '<emitter type="envmap"><string name="filename" value="FILE"/></emitter> inside <scene>'
        if where.lower().endswith(shipped.USD_ENDINGS):
            emitter = "a DomeLight"
        missing = f"{where}: no environment emitter: add {emitter}, {_GIVE_MAP}"
        note = "no environment emitter: the map lights the scene beside any lamps of its own"
        return OwnMap(None, factor, (note,), missing=missing, added=True)
    props = state.nodes[index].props
    if props.plugin_name() == "constant" and props.id() == PLACEHOLDER:
        return OwnMap(None, factor)
    if props.plugin_name() != "envmap":
        return OwnMap(None, factor, light=OwnLight.of(state, index, where))
    place = parser.place_of(state, state.nodes[index], where)

    # ---- Scale and rotation
    own: Any = props.get("scale", 1.0)
    number = isinstance(own, int | float) and not isinstance(own, bool)
    if not number or not math.isfinite(own) or not 0 < float(np.float32(own)) < math.inf:
        raise InputError(f"{place}: scale of the environment map is {own}, expected a number above 0")
    matrix = getattr(props.get("to_world", None), "matrix", np.eye(4))
    size = float(np.linalg.norm(np.array(matrix, np.float64).reshape(4, 4)[:3, 0]))
    notes = []
    if np.isfinite(size) and abs(size - 1) > _ROUNDING:
        notes.append(
            f"to_world of the environment map scales by {size:.4g}: taken as the rotation in it, while "
            "Mitsuba would look up wrong elevations"
        )
    if isinstance(scale, str):
        factor = float(own)
    elif scale != own:
        notes.append(f"scale {scale:g} (scene.scale) takes the place of the emitter's, {own:g}")

    # ---- Texels, or a file in the first folder that has it
    if "bitmap" in props:
        return OwnMap(None, factor, tuple(notes), OwnLight.of(state, index, where))
    name = props.get("filename", None)
    if not isinstance(name, str) or not name:
        missing = f"{place}: the environment map names no file; name one, {_GIVE_MAP}"
        return OwnMap(None, factor, tuple(notes), missing=missing)
    paths = [folder / name for folder in folders if os.path.isfile(folder / name)]
    return OwnMap(Path(paths[0] if paths else next(iter(folders)) / name), factor, tuple(notes))


@dataclass(frozen=True)
class Integrator:
    """What the scene's integrator asks of a rendering."""

    max_depth: int = -1  # longest path in segments, as Mitsuba counts them; -1: any
    rr_depth: int = ROULETTE  # path length in segments from which on Russian roulette ends paths
    hide_emitters: bool = False  # the camera sees neither the environment nor shapes that are lamps
    notes: tuple[str, ...] = ()  # what is used otherwise


def take_integrator(state: mi.parser.ParserState, where: str) -> Integrator:
    """Read what the integrator asks for and put ``path`` in its place, so that it is never built.

    InputError if the scene has a participating medium and an integrator that would render it, or if
    ``max_depth`` or ``rr_depth`` is out of range.
    """
    # ---- The integrator inside all wrappers
    for n in state.nodes:  # of a dict, the parser does not know the type of a plugin written in Python
        if n.type == mi.ObjectType.Unknown and n.props.plugin_name() in PATHS + DIRECT + VOLUMES:
            n.type = mi.ObjectType.Integrator
    nodes = [n for n in state.nodes if n.type == mi.ObjectType.Integrator]
    node = next(iter(nodes), None)
    notes = []
    while node is not None and node.props.plugin_name() in WRAPPERS:
        if node.props.plugin_name() == "stokes":
            notes.append("integrator stokes: rendered without polarisation")
        wrapped = parser.inside(state, node, mi.ObjectType.Integrator)
        if not wrapped:
            break
        node = state.nodes[wrapped[0]]

    # ---- Its path depth, Russian roulette and hidden emitters
    props = mi.Properties("path") if node is None else node.props
    name = props.plugin_name()
    hide = props.get("hide_emitters", False) is True
    depth, roulette = -1, ROULETTE
    if name in DIRECT:
        depth = 2
    elif name in PATHS + VOLUMES:
        depth, roulette = props.get("max_depth", -1), props.get("rr_depth", ROULETTE)
    else:
        notes.append(f"integrator {name} is not used: rendered by path, with paths of any length")
    for key, value, expected in (("max_depth", depth, "-1 or "), ("rr_depth", roulette, "")):
        whole = isinstance(value, int) and not isinstance(value, bool)
        if not whole or not (value > 0 or expected and value == -1):
            place = parser.place_of(state, node, where)
            raise InputError(f"{place}: {key} is {value}, expected {expected}a whole number above 0")

    # ---- All give way to path
    _check_media(state, where, name, notes)
    for n in nodes:
        identity = n.props.id()
        n.props = mi.Properties("path")
        n.props.set_id(identity)
        n.props["max_depth"], n.props["hide_emitters"] = depth, hide
        if roulette != ROULETTE:
            n.props["rr_depth"] = roulette
    return Integrator(depth, roulette, hide, tuple(notes))


def polarised(state: mi.parser.ParserState) -> tuple[str, ...]:
    """Say which materials of the scene polarise light, which is not followed."""
    names = sorted({n.props.plugin_name() for n in state.nodes if n.props.plugin_name() in POLARISING})
    return (f"{', '.join(names)}: rendered without polarisation",) if names else ()


def _check_media(state, where, integrator, notes):
    """Refuse media that the scene's integrator would render; say that another one leaves them out."""
    media = [n for n in state.nodes if n.type == mi.ObjectType.Medium]
    if not media:
        return
    kind = media[0].props.plugin_name()
    if integrator in VOLUMES:
        raise InputError(
            f"{parser.place_of(state, media[0], where)}: participating medium ({kind}): envedit renders "
            "surfaces only; remove the medium from the scene"
        )
    notes.append(f"medium {kind} is not rendered, as the scene's integrator ({integrator}) has no media")


def take_sensors(
    state: mi.parser.ParserState, where: str, selection: str | Sequence[int | str] = "all"
) -> tuple[list[int], list[str], tuple[str, ...]]:
    """Choose the sensors whose pictures are edited, in the order asked for; the scene has no others then.

    ``selection`` is "all", or indices and ids. Returns the indices of their nodes; their ids, or ``sensor N``
    where one has none; and a note, which of several are used. ConfigError if there is no such
    sensor or one is asked for twice, InputError if one is of a kind that makes no picture.
    """
    # ---- Choose
    sensors = [i for i, n in enumerate(state.nodes) if n.type == mi.ObjectType.Sensor]
    if not sensors:
        raise InputError(f'{where}: the scene has no sensor; add <sensor type="perspective">')
    ids = [state.nodes[i].props.id() for i in sensors]
    chosen = list(range(len(sensors)))
    if selection != "all":
        shown = [_name(state.nodes[i]) for i in sensors]
        chosen = [index_of(name, ids, shown, "scene.sensors: got") for name in selection]
    if len({*chosen}) != len(chosen):
        raise ConfigError(f"scene.sensors: got {list(selection)}, expected each sensor once")
    nodes = [sensors[k] for k in chosen]
    for i in nodes:
        kind = state.nodes[i].props.plugin_name()
        if kind not in SENSORS:
            place = parser.place_of(state, state.nodes[i], where)
            expected = ", ".join(SENSORS)
            raise InputError(f"{place}: sensor {kind} makes no picture to edit by; expected {expected}")
    names = [ids[k] or f"sensor {k}" for k in chosen]
    if len(sensors) == 1:
        return nodes, names, ()

    # ---- Leave out the others, and say so
    _keep_only(state, nodes)
    used = ", ".join(_name(state.nodes[i]) for i in nodes)
    return nodes, names, (f"{len(nodes)} of {len(sensors)} sensors used: {used}",)


def require_one_sensor(state: mi.parser.ParserState, where: str) -> None:
    """Refuse a scene with several sensors of which none was chosen, with a ConfigError that names them."""
    names = [n.props.id() for n in state.nodes if n.type == mi.ObjectType.Sensor]
    if len(names) > 1:
        known = ", ".join(names)
        how = f'--camera {names[0]}, or [scene] sensors = ["{names[0]}"]'
        raise ConfigError(f"{where}: {len(names)} cameras ({known}): choose one, such as {how}")


def index_of(identifier: int | str, names: list[str], shown: list[str], prefix: str, more: str = "") -> int:
    """Return the index of what is asked for by index or name.

    ConfigError if there is none: its text begins with ``prefix``, lists ``shown`` and ends with ``more``.
    """
    if identifier in names:
        return names.index(identifier)
    if isinstance(identifier, int) and 0 <= identifier < len(names):
        return identifier
    known = ", ".join(f"{k} ({name})" for k, name in enumerate(shown))
    raise ConfigError(f"{prefix} {identifier!r}, expected one of {known}{more}")


def _keep_only(state, nodes):
    """Let the scene refer to these sensors only, in this order."""
    for node in state.nodes:
        for name, i in parser.references(node).items():
            if state.nodes[i].type == mi.ObjectType.Sensor:
                del node.props[name]
    for k, i in enumerate(nodes):
        state.root.props[f"view_{k}_of_{len(nodes)}"] = mi.Properties.ResolvedReference(i)


def _name(node):
    return f"{node.props.plugin_name()} {node.props.id()}".strip()
