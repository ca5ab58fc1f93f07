"""The analytic sun and sky, baked into a lat-long map."""

import math

import numpy as np

from envedit.core import latlong

SUN_APERTURE = 0.5358
"""Angle across the sun's disc in degrees, the plugin's default."""


def sunsky(
    width: int,
    azimuth: float,
    elevation: float,
    turbidity: float = 3.0,
    *,
    ground_albedo: float = 0.2,
    sun_scale: float = 1.0,
    sky_scale: float = 1.0,
) -> np.ndarray:
    """Bake Mitsuba's ``sunsky`` emitter (Hosek and Wilkie 2012, 2013) into a lat-long map, +Y up.

    Sky texels are averages over stratified directions in the texel. The sun, 0.54 degrees across and
    smaller than most texels, is integrated by itself and its flux laid into the texels it covers, so that a
    rendering under the map receives all of it at any width (from the texels' centres: up to half a texel
    off). Below the horizon the plugin is black; here lies a ground that reflects ``ground_albedo *
    irradiance / pi``, as a black half would be degenerate in log space.

    ``width``, ``azimuth``, ``elevation`` and ``turbidity`` are those of :func:`envedit.sunsky`: the sun
    stands at column ``azimuth / 360 * width - 1/2``, row ``(90 - elevation) / 180 * (width / 2 - 1)``.
    ``ground_albedo`` is the ground's reflectance, 0 to 1, which lights the sky as well; ``sun_scale`` and
    ``sky_scale`` are factors on the radiance of either. Returned is linear radiance in the plugin's units,
    (width / 2, width, 3) float32.
    """
    # ---- Sky and sun, each an emitter of its own
    height = width // 2
    # The plugin is black for a sun in the horizon itself, to float32: one hundredth of a degree is above it.
    sun_direction = latlong.on_sphere(math.radians(90 - max(elevation, 0.01)), math.radians(azimuth % 360.0))
    common = {"turbidity": turbidity, "albedo": ground_albedo, "sun_direction": _z_up(sun_direction)}
    sky = _sunsky_emitter(sun_scale=0.0, sky_scale=sky_scale, **common)
    sun = _sunsky_emitter(sun_scale=sun_scale, sky_scale=0.0, **common)

    # ---- The sky averaged over texels, over ground that both light; the sun added as points
    points = disc(sun_direction, math.radians(SUN_APERTURE / 2), width)
    flux = sun(points) * (2 * math.pi * (1 - math.cos(math.radians(SUN_APERTURE / 2))) / len(points))
    irradiance = (flux * points[:, 1:2]).sum(0) + _sky_irradiance(sky)
    image = _average(sky, height, width, ground_albedo * irradiance / math.pi)

    add_flux(image, points, flux)
    return np.maximum(image, 0).astype(np.float32)  # the plugin's fit is negative beside a low sun


def _z_up(d):
    """Turn directions (..., 3) from our frame, +Y up, to the plugin's, +Z up."""
    return np.stack([d[..., 0], -d[..., 2], d[..., 1]], axis=-1)


def _sunsky_emitter(sun_direction, **parameters):
    """Return a function from directions (N, 3), +Y up, to the plugin's radiance (N, 3) float64."""
    import drjit as dr
    import mitsuba as mi

    from envedit.core import installed_plugins

    # A scene around it: the emitter needs one to know its bounds. Its texels are then evaluated like any
    # other.
    plugin = {"type": "sunsky", "sun_direction": sun_direction.tolist(), "sun_aperture": SUN_APERTURE}
    installed_plugins.come_first()
    emitter = mi.load_dict({"type": "scene", "emitter": plugin | parameters}).environment()

    def radiance(d):
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = -mi.Vector3f(*_z_up(d).T.astype(np.float32))
        return np.array(emitter.eval(si), np.float64).T

    return radiance


def disc(centre: np.ndarray, radius: float, width: int) -> np.ndarray:
    """Return directions (N, 3) spread evenly over a disc of the sky, as Vogel's spiral.

    Enough of them that the texels inside the disc of a map of so many columns are evenly filled. ``centre``
    is the unit vector to its centre, ``radius`` in radians.
    """
    count = 16384 + 512 * int(math.pi * (radius / (2 * math.pi / width)) ** 2)
    i = np.arange(count) + 0.5
    # Even in solid angle: 1 - cos(angle) runs linearly; 2 sin^2(angle / 2) keeps its digits.
    angle = 2 * np.arcsin(np.sqrt(i / count) * math.sin(radius / 2))
    phi = i * (math.pi * (3 - math.sqrt(5)))
    side = np.cross(centre, [1.0, 0, 0] if abs(centre[0]) < 0.7 else [0, 0, 1.0])
    side /= np.linalg.norm(side)
    offset = np.cos(phi)[:, None] * side + np.sin(phi)[:, None] * np.cross(centre, side)
    return np.cos(angle)[:, None] * centre + np.sin(angle)[:, None] * offset


def add_flux(image: np.ndarray, points: np.ndarray, flux: np.ndarray) -> None:
    """Add flux (N, 3) from directions (N, 3) to the nearest texels of a map (H, W, 3), in place.

    A rendering receives all of it, whatever the texels' size.
    """
    height, width, _ = image.shape
    row, column = latlong.texel_position(points, height, width)
    row, column = np.rint(row).astype(int), np.rint(column).astype(int) % width
    np.add.at(image, (row, column), flux / latlong.lookup_solid_angles(height, width)[row, None])


def _sky_irradiance(sky):
    """Return the sky's horizontal irradiance (3,): pi times its mean over cosine-distributed directions."""
    i = (np.arange(256) + 0.5) / 256
    theta, phi = np.meshgrid(np.arcsin(np.sqrt(i)), 2 * np.pi * i, indexing="ij")
    return math.pi * sky(latlong.on_sphere(theta, phi).reshape(-1, 3)).mean(0)


def _average(sky, height, width, ground):
    """Return the sky (H, W, 3) averaged over each texel, with the ground below the horizon, in float64."""
    n = max(2, min(8, 2048 // width))  # strata a side: the narrower the map, the more a texel holds
    edges = np.cos(np.pi * latlong.row_edges(height))
    part = (np.arange(n) + 0.5) / n
    phi = 2 * np.pi * (np.arange(width)[:, None] + part).ravel() / width
    image = np.empty((height, width, 3))
    chunk = max(1, (1 << 21) // (n * n * width))
    for top in range(0, height, chunk):
        rows = slice(top, min(top + chunk, height))
        low, high = edges[rows], edges[rows.start + 1 : rows.stop + 1]
        y = low[:, None] + (high - low)[:, None] * part  # even in y is even in solid angle
        d = latlong.on_sphere(np.arccos(y).reshape(-1, 1), phi)
        value = sky(d.reshape(-1, 3)).reshape(d.shape)
        value = np.where(d[..., 1:2] > 0, value, ground)
        image[rows] = value.reshape(len(low), n, width, n, 3).mean((1, 3))
    return image
