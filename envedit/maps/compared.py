"""Two maps side by side: as pictures, as light on surfaces, and light by light."""

from __future__ import annotations

import numpy as np

from envedit import config
from envedit.core import latlong
from envedit.core.color import luminance
from envedit.export import file_lights, light_list
from envedit.losses import metrics
from envedit.losses.perceptual import distances, installed
from envedit.maps import map_lights

METRIC_WIDTH = 2048
"""Most columns of the copies that PSNR, SSIM and LPIPS are taken of: in double precision SSIM of 8192 columns
would take 10 GB."""


def compare(first: np.ndarray, second: np.ndarray) -> dict:
    """Compare a map with a reference of the same size.

    Parameters
    ----------
    first, second : ndarray (H, W, 3) float32
        The reference and the map, linear radiance in Rec. 709.

    Returns
    -------
    dict
        ``identical``; ``psnr``, ``ssim``, ``lpips``, ``log_rmse``, ``beyond_display`` of
        :func:`.metrics.compare` at ``metric_width`` columns, ``lpips`` None without trained weights;
        ``irradiance``: by axis, luminance ``first`` and ``second``, and ``stops``, log2 of the second over
        the first ("+y" is the horizontal plane); ``lights``: ``before`` and ``after`` of
        :func:`.light_list.matched`, where a light of both has ``stops_of_flux``.
    """
    width = min(first.shape[1], METRIC_WIDTH)
    small = [
        latlong.resize(one, width // 2, width) if width < one.shape[1] else one for one in (first, second)
    ]
    measured = metrics.compare(small[1], small[0], lpips=_lpips())
    measured |= {"identical": bool(np.array_equal(first, second)), "metric_width": width}
    return measured | {"irradiance": _irradiance(first, second), "lights": _lights(first, second)}


def _irradiance(first, second):
    """Return irradiance on surfaces that face the axes, in luminance and in stops."""
    normals = np.array(list(map_lights.AXES.values()))
    on = [luminance(map_lights.irradiance(one, normals)).tolist() for one in (first, second)]
    return {
        axis: {"first": a, "second": b, "stops": map_lights.stops(b, a)}
        for axis, a, b in zip(map_lights.AXES, *on, strict=True)
    }


def _lights(first, second):
    """Match the lights of the maps, and compare their fluxes."""
    separated = [file_lights.lights_of(one).lights for one in (first, second)]
    tables = [light_list.listed(own, first.shape[:2], np.eye(3)) for own in separated]
    matched = light_list.matched(tables[0], tables[1])
    flux = {light["id"]: float(luminance(light["flux"])) for light in matched["before"]}
    for light in matched["after"]:
        own = float(luminance(light["flux"]))
        light["stops_of_flux"] = map_lights.stops(own, flux.get(light["id"], 0.0))
    return matched


def _lpips():
    """Load LPIPS where its weights are; None elsewhere."""
    files = installed.files(config.Config())
    if "backbone" not in files:
        return None
    network = config.Config().perceptual.network
    return distances.Lpips(network, files["backbone"], files["heads"])
