"""Two maps side by side: as pictures, as light on surfaces, and light by light."""

from __future__ import annotations

import numpy as np

from envedit import config
from envedit.core import latlong
from envedit.core.color import luminance
from envedit.export import light_list
from envedit.losses import metrics
from envedit.losses.perceptual import installed
from envedit.maps import map_lights
from envedit.representations.layers import file_lights

METRIC_WIDTH = 2048
"""Most columns of the copies that pictures and irradiance are compared on: in double precision SSIM of 8192
columns would take 10 GB."""


def reduced(radiance: np.ndarray) -> np.ndarray:
    """Return a map (H, W, 3) at no more than :data:`METRIC_WIDTH` columns, with its flux."""
    if radiance.shape[1] <= METRIC_WIDTH:
        return radiance
    return latlong.resize(radiance, METRIC_WIDTH // 2, METRIC_WIDTH)


def pictures(first: np.ndarray, second: np.ndarray) -> dict:
    """Compare a reduced map with a reduced reference of the same size (H, W, 3), as pictures and as light.

    Returns ``psnr``, ``ssim``, ``lpips``, ``log_rmse``, ``beyond_display`` of :func:`.metrics.compare`,
    ``lpips`` None without trained weights; ``width``; ``irradiance``: by axis, luminance ``first`` and
    ``second``, and ``stops``, log2 of the second over the first ("+y" is the horizontal plane).
    """
    measured = metrics.compare(second, first, lpips=installed.load(config.Config()).lpips)
    return measured | {"width": first.shape[1], "irradiance": _irradiance(first, second)}


def _irradiance(first, second):
    """Return irradiance on surfaces that face the axes, in luminance and in stops."""
    normals = np.array(list(map_lights.AXES.values()))
    on = [luminance(map_lights.irradiance(envmap, normals)).tolist() for envmap in (first, second)]
    return {
        axis: {"first": a, "second": b, "stops": map_lights.stops(b, a)}
        for axis, a, b in zip(map_lights.AXES, *on, strict=True)
    }


def lights(first: np.ndarray, second: np.ndarray) -> dict:
    """Match the lights of two maps of one size (H, W, 3).

    Returns ``before`` and ``after`` of :func:`.light_list.matched`, the latter with ``stops_of_flux`` over
    that of the light of the first map; None for one that is new.
    """
    separated = [file_lights.lights_of(envmap) for envmap in (first, second)]
    tables = [light_list.listed(own, first.shape[:2], np.eye(3)) for own in separated]
    matched = light_list.matched(tables[0], tables[1])
    flux = {light["id"]: float(luminance(light["flux"])) for light in matched["before"]}
    for light in matched["after"]:
        own = float(luminance(light["flux"]))
        light["stops_of_flux"] = map_lights.stops(own, flux.get(light["id"], 0.0))
    return matched
