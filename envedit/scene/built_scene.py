"""Scenes that somebody has built: a ``mitsuba.Scene`` in the place of a file.

What :func:`.scene.load` changes in a scene's nodes is fixed in a built scene, so that it must be fit for use:
lit by an ``envmap``, its film as large as the rendering. Its texels are set by :meth:`.Scene.set_envmap` as
always; :func:`kept` puts them back.
"""

from __future__ import annotations

import contextlib
import os
import re
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np

from envedit import config
from envedit.core import latlong, rotations
from envedit.core.errors import ConfigError, InputError
from envedit.core.types import FilePath
from envedit.scene import scene as scenes
from envedit.scene.scene import Scene
from envedit.scene.supported import ROULETTE, Integrator, OwnMap

_CAMERAS = ("PerspectiveCamera", "ThinLensCamera", "OrthographicCamera")
# Names of classes, of which an integrator written in Python has another in Python than in C++.
_PATHS = {
    "PathIntegrator",
    "PRBIntegrator",
    "BasicPRBIntegrator",
    "PathProjectiveIntegrator",
    "ParticleTracerIntegrator",
}
_DIRECT = {"DirectIntegrator", "DirectProjectiveIntegrator"}
_VOLUMES = {"VolumetricPathIntegrator", "VolpathMisIntegratorImpl", "PRBVolpathIntegrator"}
UNKNOWN = "built "
"""How the digest of a built scene begins: it says nothing of what the scene consists of."""
_ROUNDING = 1e-4  # of a rotation's columns
_ANY_DEPTH = 2**32 - 1  # as Mitsuba prints a depth of -1


def load(scene: object, settings: config.Scene, base: FilePath | None = None) -> Scene:
    """Take a scene in any form; of ``settings`` all but ``file`` counts.

    ``scene`` is a file, the name of a shipped scene, a mapping as ``mi.load_dict`` takes it, a Scene, which
    is returned as it is, or a built ``mitsuba.Scene``, for which all but ``sensors`` and ``scale`` is fixed.
    ``base`` is that of :func:`.scene.load`. ConfigError and InputError are as of it and of :func:`wrapped`,
    also if it is none of these.
    """
    if isinstance(scene, Scene):
        return scene
    if isinstance(scene, Mapping):
        scene = dict(scene)
    if isinstance(scene, str | os.PathLike | dict):
        return scenes.load(
            scene,
            settings.width,
            settings.height,
            dict(settings.parameters),
            base,
            sensors=settings.sensors,
            up=settings.up,
            scale=settings.scale,
        )
    wrapped_scene = wrapped(scene, settings.sensors)
    if isinstance(settings.scale, str):
        return wrapped_scene
    return replace(wrapped_scene, own=OwnMap(None, settings.scale))


def is_built(scene: object) -> bool:
    """Return whether this is a ``mitsuba.Scene``, of any variant."""
    return type(scene).__name__ == "Scene" and hasattr(scene, "environment")


def wrapped(scene: Any, sensors: str | Sequence[int | str] = "all") -> Scene:
    """Make the environment of a built scene replaceable.

    The ``scale`` of its ``envmap`` becomes 1, as that of every :class:`.Scene`; the former one is in ``own``.
    Light transport and renderings of such a scene are not found on disk by another run: what it is
    made of cannot be read from it. ``sensors`` is "all", or [0] where the scene has one sensor.

    ConfigError if it is no scene of the present variant, or some of several sensors are asked for. InputError
    if its environment is no ``envmap``, or stands askew, a sensor is of a kind that makes no picture, or
    there is a medium that its integrator would render.
    """
    # ---- Refuse what makes no picture of a map
    if not is_built(scene):
        what = type(scene).__name__
        raise ConfigError(f"scene: got {what}, expected a file, a dict, or a mitsuba.Scene")
    if scene.variant_name() != mi.variant():
        raise ConfigError(
            f"scene: got one of variant {scene.variant_name()}, expected {mi.variant()}: build it after "
            f'mi.set_variant("{mi.variant()}"), or set variant in the configuration'
        )
    cameras = scene.sensors()
    if sensors != "all" and len(cameras) > 1:
        raise ConfigError(
            f"scene.sensors: got {list(sensors)} for a built scene with {len(cameras)} sensors, expected "
            '"all": build it with the sensors to use'
        )
    for camera in cameras:
        if camera.class_name() not in _CAMERAS:
            kind = camera.class_name()
            raise InputError(f"scene: sensor {kind} makes no picture; expected {', '.join(_CAMERAS)}")
    if not cameras:
        raise InputError("scene: got no sensor, expected at least one")

    # ---- The environment map; its scale is taken out
    params = mi.traverse(scene)
    key = _texels(scene)
    stem = key.removesuffix("data")
    to_world = _rotation(params[f"{stem}to_world"])
    scale = float(np.array(params[f"{stem}scale"]).item())
    if not (np.isfinite(scale) and scale > 0):
        raise InputError(f"scene: scale of the environment map is {scale}, expected a number above 0")
    params[f"{stem}scale"] = 1.0
    params.update()

    # ---- Sensors and integrator
    width, views = scenes.views_of(scene, [c.id() or f"sensor {k}" for k, c in enumerate(cameras)])
    integrator = _integrator(scene)
    return Scene(
        scene,
        path=None,
        width=width,
        height=views[-1].rows.stop,
        envmap_key=key,
        to_world=to_world,
        digest=UNKNOWN + uuid.uuid4().hex,
        params=params,
        views=views,
        own=OwnMap(None, scale),
        integrator=integrator,
        notes=integrator.notes,
    )


def own_map(scene: Any) -> np.ndarray:
    """Return the texels of a built scene's ``envmap``, (H, W, 3) float32, without its scale."""
    return latlong.from_envmap_data(mi.traverse(scene)[_texels(scene)])


@contextlib.contextmanager
def kept(scene: Any) -> Iterator[None]:
    """Put the texels and the scale of a built scene's ``envmap`` back in the end."""
    params, key = mi.traverse(scene), _texels(scene)
    scale = f"{key.removesuffix('data')}scale"
    before = type(params[key])(params[key]), type(params[scale])(params[scale])
    try:
        yield
    finally:
        params[key], params[scale] = before
        params.update()


def _texels(scene: Any) -> str:
    """Return the name of the texels among the parameters of a scene."""
    light = scene.environment()
    if light is None or light.class_name() != "EnvironmentMapEmitter":
        kind = "none" if light is None else light.class_name()
        raise InputError(f"scene: got environment {kind}, expected an emitter of type envmap")
    ending = f"{light.id()}.data"
    return next(k for k, _ in mi.traverse(scene) if k == ending or k.endswith(f".{ending}"))


def _rotation(transform: Any) -> np.ndarray:
    """Return the rotation (3, 3) of a transformation."""
    matrix = np.array(transform.matrix, np.float64).reshape(4, 4)[:3, :3]
    rotation = rotations.rotation_in(matrix, _ROUNDING)
    if rotation is None or np.abs(rotation - matrix).max() > _ROUNDING:
        raise InputError("scene: to_world of the environment map is no rotation; scale the scene instead")
    return matrix


def _integrator(scene: Any) -> Integrator:
    """Read what the integrator asks for, as :func:`.supported.take_integrator`."""
    integrator = scene.integrator()
    media = any(shape.is_medium_transition() for shape in scene.shapes())
    names = {"PathIntegrator"}
    if integrator is not None:
        names = {integrator.class_name(), type(integrator).__name__}
    hide = bool(getattr(integrator, "hide_emitters", False))
    notes = []
    if media and names & _VOLUMES:
        raise InputError("scene: participating medium: envedit renders surfaces only; remove the medium")
    if media:
        notes.append("the scene's medium is not rendered, as its integrator has no media")
    if names & _DIRECT:
        return Integrator(2, ROULETTE, hide, tuple(notes))
    if not names & (_PATHS | _VOLUMES):
        kind = integrator.class_name()
        notes.append(f"integrator {kind} is not used: rendered by path, with paths of any length")
        return Integrator(-1, ROULETTE, hide, tuple(notes))
    printed = dict(re.findall(r"(\w+_depth) = (\d+)", str(integrator)))
    depth = int(printed.get("max_depth", _ANY_DEPTH))
    roulette = int(printed.get("rr_depth", getattr(integrator, "rr_depth", ROULETTE)))
    return Integrator(-1 if depth >= _ANY_DEPTH else depth, roulette, hide, tuple(notes))
