"""Images and weights that recorded scores of DISTS and LPIPS are of, drawn by numpy.

tests/data/perceptual has what the authors' packages make of them, in double precision, recorded by
experiments/references/perceptual.py of commit d86377dc: torch 2.13.0, torchvision 0.28.0, lpips 0.1.4,
DISTS-pytorch 0.1.
"""

import zlib

import numpy as np

CHANNELS = {
    "vgg": (64, 128, 256, 512, 512),
    "alex": (64, 192, 384, 256, 256),
}
CASES = (
    ("dists", "vgg", (24, 40)),
    ("dists", "vgg", (33, 47)),
    ("dists", "vgg", (5, 3)),
    ("lpips", "vgg", (33, 47)),
    ("lpips", "alex", (47, 61)),
)
DIRECTIONS = 4
SEEDS = {"alex": 0, "vgg": 2}


def shapes(kind):
    """Shapes of the convolutions of a network (O, I, k, k), by torchvision's names."""
    if kind == "vgg":
        widths = [3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512]
        places = [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]
        found = {i: (o, n, 3, 3) for i, n, o in zip(places, widths[:-1], widths[1:], strict=True)}
    else:
        found = {0: (64, 3, 11, 11), 3: (192, 64, 5, 5), 6: (384, 192, 3, 3), 8: (256, 384, 3, 3)}
        found[10] = (256, 256, 3, 3)
    return {f"features.{i}": shape for i, shape in found.items()}


def tensors(kind):
    """Draw the weights of a network: a float32 state dict whose layers keep the size of what goes through."""
    rng = np.random.default_rng(SEEDS[kind])
    found = {}
    for name, shape in shapes(kind).items():
        weight = rng.standard_normal(shape, np.float32) * np.float32((2 / np.prod(shape[1:])) ** 0.5)
        found[name + ".weight"] = weight
        found[name + ".bias"] = rng.uniform(-0.1, 0.1, shape[0]).astype(np.float32)
    return found


def heads(kind):
    """Draw the heads of LPIPS, float32 (1, C, 1, 1)."""
    rng = np.random.default_rng(100)
    return {
        f"lin{i}.model.1.weight": rng.random((1, c, 1, 1), np.float32) for i, c in enumerate(CHANNELS[kind])
    }


def alpha_beta():
    """Draw the weights of DISTS, float32 (1, 1475, 1, 1)."""
    rng = np.random.default_rng(200)
    return {name: rng.random((1, 3 + sum(CHANNELS["vgg"]), 1, 1), np.float32) for name in ("alpha", "beta")}


def images(height, width):
    """Make two images in [0, 1] that resemble each other, and directions in which gradients are seen."""
    rng = np.random.default_rng(1000 * height + width)
    r, c = np.mgrid[:height, :width]
    y = np.stack([0.5 + 0.3 * np.sin(0.31 * r + 0.17 * k * c) * np.cos(0.05 * k * c) for k in (1, 2, 3)], -1)
    y = np.clip(y + 0.1 * rng.standard_normal(y.shape), 0, 1)
    x = np.clip(0.7 * np.roll(y, 2, axis=1) + 0.2 * y + 0.1 * rng.random(y.shape), 0, 1)
    return x, y, rng.standard_normal((DIRECTIONS, *y.shape))


def pairs():
    """Make ten pairs of images, from all but the same to as unlike as those of :func:`images`."""
    for k in range(10):
        x, y, _ = images(*((40, 64), (52, 39))[k % 2])
        share = 0.05 * 20 ** (k / 9)
        yield share * x + (1 - share) * y, y


def checksum(drawn):
    """CRC of arrays: whether numpy draws the same ones as when the file was recorded."""
    crc = 0
    for values in drawn:
        crc = zlib.crc32(np.ascontiguousarray(values), crc)
    return np.uint32(crc)
