"""A region of a map filled from around it, by OpenCV's inpainting (Telea 2004), an extra.

Near the poles a lat-long image is stretched, and at its edge a region is in two parts. What surrounds the
region is therefore resampled to the azimuthal equidistant projection about its middle, filled there in log
radiance, and only the region's texels are put back.
"""

from __future__ import annotations

import numpy as np

from envedit.core import latlong
from envedit.core.extras import required
from envedit.core.resampling import bilinear
from envedit.core.rows import bands

MOST_PIXELS = 1024
"""Pixels across of the projection: a larger one takes seconds, and what is filled in is smooth."""
MARGIN = 8
"""Pixels of the surroundings on each side; Telea's method reads :data:`RADIUS` of them."""
RADIUS = 3
CODES = 1e5
"""Range of the values that OpenCV is given: to its estimate it adds up to sqrt(2) whatever their unit is
(``Jx + Jy`` over its length, in photo/src/inpaint.cpp), of this range 1e-5."""
ROWS = 128


class NothingAroundError(ValueError):
    """The region is all of the map."""


def filled(envmap: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return a map with a region replaced by what continues its surroundings.

    ``envmap`` (H, W, 3) float32 is linear radiance, finite and not negative; ``weight`` (H, W), 0 to 1, how
    far a texel is replaced: texels of weight 0 keep their bits. What is filled in is within the range of what
    is :data:`RADIUS` pixels around the region, in each channel. NothingAroundError if the weight is above 0
    everywhere, MachineError if OpenCV is not installed.
    """
    cv2 = required("cv2", "inpaint", 'input.regions: action = "fill"')
    mask = weight > 0
    if not mask.any():
        return envmap
    if mask.all():
        raise NothingAroundError

    # ---- The projection: its middle, pixels and directions
    height, width, _ = envmap.shape
    texel = np.pi / (height - 1)
    frame, radius = _cap(mask)
    pixel = max(texel, 2 * radius / MOST_PIXELS)
    half = int(np.ceil(min(radius, np.pi) / pixel)) + MARGIN
    offset = pixel * np.arange(-half, half + 1)
    x, y = np.meshgrid(offset, offset)
    angle = np.hypot(x, y)
    sine = np.sinc(angle / np.pi)  # sin(angle) / angle
    plane = np.stack([x * sine, y * sine, np.cos(angle)], axis=-1) @ frame

    # ---- The map in it; unknown is what reads a texel of the region
    row, column = latlong.texel_position(plane, height, width)
    known = bilinear(envmap, row, column, around=True)
    unknown = bilinear(mask[..., None], row, column, around=True)[..., 0] > 0
    unknown |= angle > np.pi
    ring = cv2.dilate(unknown.astype(np.uint8), np.ones(2 * (2 * RADIUS + 1,), np.uint8)) > 0
    ring &= ~unknown
    if not ring.any():
        raise NothingAroundError

    image = _inpainted(cv2, known, unknown, ring)

    # ---- The region's texels of it
    result = envmap.copy()
    for band in bands(height, ROWS):
        rows, columns = np.nonzero(mask[band])
        if not len(rows):
            continue
        toward = latlong.directions(height, width, band)[rows, columns]
        x, y, z = (toward @ frame.T).T
        across = np.hypot(x, y)
        stretch = np.arctan2(across, z) / np.maximum(across, 1e-12) / pixel
        filling = bilinear(image, y * stretch + half, x * stretch + half)
        share = weight[band][rows, columns][:, None]
        old = envmap[band][rows, columns]
        result[band][rows, columns] = np.where(share == 1, filling, old + share * (filling - old))
    return result


def _inpainted(cv2, known, unknown, ring):
    """Fill unknown pixels of an image (n, n, 3) in log radiance, a channel at a time, in a ring's range."""
    image = np.empty(known.shape)
    for c in range(3):
        around = known[ring][:, c]
        positive = around[around > 0]
        floor = positive.min() if len(positive) else 1.0
        low, high = np.log(floor), np.log(max(around.max(), floor))
        scale = CODES / max(high - low, 1e-6)
        codes = np.clip((np.log(np.maximum(known[..., c], floor)) - low) * scale, 0, CODES)
        done = cv2.inpaint(np.float32(codes), unknown.astype(np.uint8), RADIUS, cv2.INPAINT_TELEA)
        radiance = np.exp(low + np.clip(np.float64(done), 0, CODES) / scale)
        image[..., c] = np.clip(radiance, around.min(), around.max())
    return image


def _cap(mask):
    """Return axes (3, 3), of which the last is the middle of a mask (H, W), and the angle that it reaches."""
    height, width = mask.shape
    step = max(1, height // 256)
    coarse = np.logical_or.reduceat(mask, np.arange(0, height, step), axis=0)
    coarse = np.logical_or.reduceat(coarse, np.arange(0, width, step), axis=1)
    rows, columns = (np.minimum(at * step + step // 2, most - 1) for at, most in
                     zip(np.nonzero(coarse), mask.shape, strict=True))  # fmt: skip
    polar = np.pi * rows / (height - 1)
    toward = latlong.on_sphere(polar, 2 * np.pi * (columns + 0.5) / width)
    middle = (toward * np.sin(polar)[:, None]).sum(axis=0) + 1e-9 * toward[0]
    middle /= np.linalg.norm(middle)
    side = np.eye(3)[np.argmin(np.abs(middle))]
    right = np.cross(side, middle)
    right /= np.linalg.norm(right)
    away = 2 * np.arcsin(np.minimum(np.linalg.norm(toward - middle, axis=1) / 2, 1)).max()
    return np.stack([right, np.cross(middle, right), middle]), away + 2 * step * np.pi / (height - 1)
