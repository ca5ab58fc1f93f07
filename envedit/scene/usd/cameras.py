"""USD cameras as Mitsuba sensors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from pxr import UsdGeom

from envedit.core.errors import ConfigError, InputError
from envedit.scene.usd.description import Description, add

FILM_WIDTH = 768
"""Pixels across, as Mitsuba's own default; the height follows from the apertures."""
NEAR, FAR = 0.01, 1e4
"""Mitsuba's clipping distances, here in metres: USD's own are for rasterisers, and 1 unit by default."""
_TENTH = 0.1  # focal length and apertures are in tenths of the scene's unit


def choose(file: str, cameras: Sequence[tuple[Any, np.ndarray]], path: str) -> list[tuple[Any, np.ndarray]]:
    """Return the cameras (prim, transform) of a path: "" is for the only one, "all" for every one.

    ConfigError if there are several, or none of that path; InputError if there is none.
    """
    if not cameras:
        raise InputError(f"{file}: no camera that is visible; add one to the stage")
    if path == "all" or (not path and len(cameras) == 1):
        return list(cameras)
    paths = [str(prim.GetPath()) for prim, _ in cameras]
    known = ", ".join(paths)
    if not path:
        raise ConfigError(f"{file}: {len(paths)} cameras ({known}): choose one, such as --camera {paths[0]}")
    if path not in paths:
        raise ConfigError(f"--camera: got {path}, expected one of {known}")
    return [cameras[paths.index(path)]]


def add_camera(scene: Description, prim: Any, to_world: np.ndarray) -> None:
    """Add a sensor whose id is the path of a camera.

    USD looks along -z with +x to the right, Mitsuba along +z with +x to the left. The horizontal field of
    view is 2 atan(horizontalAperture / (2 focalLength)). ``to_world`` (4, 4) is from the camera to the stage;
    a scale in it does not count.
    """
    camera = UsdGeom.Camera(prim)
    focal, wide, high, right, up = (
        attribute.Get(scene.time) or 0.0
        for attribute in (
            camera.GetFocalLengthAttr(),
            camera.GetHorizontalApertureAttr(),
            camera.GetVerticalApertureAttr(),
            camera.GetHorizontalApertureOffsetAttr(),
            camera.GetVerticalApertureOffsetAttr(),
        )
    )
    if not (0 < wide < math.inf and 0 < high < math.inf and 0 < focal < math.inf):
        what = f"focal length {focal:g} and apertures {wide:g} x {high:g}"
        raise scene.error(prim.GetPath(), f"the camera has {what}, expected numbers above 0")
    height = round(FILM_WIDTH * high / wide)
    if not 1 <= height <= 16 * FILM_WIDTH:
        raise scene.error(prim.GetPath(), f"the camera has apertures {wide:g} x {high:g}")
    if camera.GetFStopAttr().Get(scene.time):
        scene.leave_out("depth of field", prim.GetPath())
    if camera.GetExposureAttr().Get(scene.time):
        scene.leave_out("exposure of a camera", prim.GetPath())

    # ---- Where it stands: the rotation nearest to the transform, without its scale
    matrix = np.eye(4)
    left, _, last = np.linalg.svd(to_world[:3, :3])
    matrix[:3, :3] = left @ last
    matrix[:3, 3] = to_world[:3, 3]
    matrix = matrix @ np.diag([-1.0, 1, -1, 1])

    # ---- Projection
    unit = UsdGeom.GetStageMetersPerUnit(scene.stage)
    clips = {"near_clip": NEAR / unit, "far_clip": FAR / unit}
    plugin = "perspective"
    values: dict[str, Any] = {"fov": math.degrees(2 * math.atan(wide / (2 * focal))), "fov_axis": "x"}
    if camera.GetProjectionAttr().Get(scene.time) == UsdGeom.Tokens.orthographic:
        plugin = "orthographic"
        values = {}
        matrix[:3, 3] += _TENTH * (-right * matrix[:3, 0] + up * matrix[:3, 1])
        matrix = matrix @ np.diag([_TENTH * wide / 2, _TENTH * wide / 2, 1.0, 1.0])
    else:
        values["principal_point_offset_x"] = right / wide
        values["principal_point_offset_y"] = -up / high
    sensor = add(scene.root, "sensor", plugin, **values, **clips, to_world=matrix)
    sensor.set("id", str(prim.GetPath()))
    add(sensor, "film", "hdrfilm", width=FILM_WIDTH, height=height)
