"""Scenes, maps and light transports of them, and Mitsuba's pictures of the same."""

import mitsuba as mi
import numpy as np

from envedit.scene import scene
from envedit.transport.light_transport import LightTransport

HEIGHT, WIDTH = 16, 32
DEPTH = 4  # of every path, here and in the reference: both leave out the same light
SEEDS = 8
T = mi.ScalarTransform4d


def colour(*rgb):
    return {"type": "rgb", "value": list(rgb)}


def ball(bsdf, x=0.0, radius=1.0):
    return {"type": "sphere", "center": [x, radius, 0], "radius": radius, "bsdf": bsdf}


def stage(*shapes, light=None, film=None, origin=(0, 3.6, 7.4), up=(0, 1, 0)):
    """Objects on a grey plane; the camera of the shipped scenes."""
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}} | (film or {})
    to_world = T().look_at(origin=list(origin), target=[0, 0.85, 0], up=list(up))
    plane = {
        "type": "rectangle",
        "to_world": T().rotate([1, 0, 0], -90).scale(100),
        "bsdf": {"type": "diffuse", "reflectance": colour(0.5, 0.5, 0.5)},
    }
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "fov": 28, "to_world": to_world, "film": film},
        "sky": light or {"type": "constant"},
        "plane": plane,
        **{f"object{i}": shape for i, shape in enumerate(shapes)},
    }


METAL = {"type": "roughconductor", "material": "Al", "alpha": 0.3}
WHITE = {"type": "diffuse", "reflectance": colour(0.8, 0.8, 0.8)}
PRINCIPLED = {
    "type": "principled",
    "base_color": colour(0.7, 0.3, 0.1),
    "metallic": 0.3,
    "roughness": 0.4,
    "clearcoat": 0.8,
    "sheen": 0.5,
}
WALL = {
    "type": "cube",
    "to_world": T().translate([-1.6, 1, 0]).scale([0.1, 1, 1]),
    "bsdf": {"type": "diffuse", "reflectance": colour(0.9, 0.1, 0.05)},
}
LAMP = {  # above the picture
    "type": "sphere",
    "center": [1.5, 4.5, 2],
    "radius": 0.5,
    "emitter": {"type": "area", "radiance": colour(6, 3, 12)},
}
TURNED = {
    "type": "envmap",
    "bitmap": mi.Bitmap(np.full((4, 8, 3), 0.5, np.float32)),
    "to_world": T().rotate([0.48, 0.8, 0.36], 70),
}
CROP = {"width": 48, "height": 40}
CROP |= {"crop_offset_x": 12, "crop_offset_y": 6, "crop_width": 24, "crop_height": 20}
SCENES = {  # a shipped one by name and parameters, or a dict
    "sphere": ("sphere", {}),
    "mirror": ("mirror", {}),
    "matte": ("matte", {}),
    "statue": ("statue", {}),
    "pair": ("pair", {}),
    "mesh": ("mesh", {"mesh": "statue.ply", "up": "z", "turn": 30}),
    "glass": stage(ball({"type": "dielectric"})),
    "sphere, alpha 1": ("sphere", {"roughness": 1.0}),
    "plastic and principled": stage(ball({"type": "plastic"}, -0.9, 0.8), ball(PRINCIPLED, 0.9, 0.8)),
    "red wall and a lamp": stage(ball(WHITE), WALL, LAMP),
    "turned and cropped": stage(ball(METAL), light=TURNED, film=CROP),
    "in the air": {k: v for k, v in stage(ball(METAL)).items() if k != "plane"},
    "mitchell filter": stage(ball(WHITE), film={"rfilter": {"type": "mitchell"}}),
}


def load(name):
    if isinstance(SCENES[name], dict):
        return scene.load(SCENES[name])
    shipped, parameters = SCENES[name]
    return scene.load(shipped, 24, 24, parameters)


def sun(row, column):
    image = np.ones((HEIGHT, WIDTH, 3), np.float32)
    image[row, column] = 1e5
    return image


def refined(image, rows=4, columns=3):
    """Return the same function of direction on a finer grid, whose texels include the centres of the old.

    Mitsuba's table of what to sample has sin(0) in the row at the pole: of a sun there it finds next to
    nothing where the next row is dark. On the finer grid the next row is the sun's.
    """
    height, width = image.shape[:2]
    row = np.arange(rows * (height - 1) + 1)[:, None] / rows - np.arange(height)
    column = (np.arange(columns * width)[:, None] + 0.5) / columns - 0.5 - np.arange(width)
    column = (column + width / 2) % width - width / 2
    tents = (np.maximum(1 - np.abs(x), 0) for x in (row, column))
    return np.einsum("ir,jc,rck->ijk", *tents, image.astype(np.float64)).astype(np.float32)


def noise(seed=0, height=HEIGHT, width=WIDTH):
    return np.random.default_rng(seed).random((height, width, 3), dtype=np.float32) ** 2 * 3


def build(s, height=HEIGHT, width=WIDTH, **options):
    options = {"spp": 64, "max_depth": DEPTH, "memory_gb": 0.5} | options
    return LightTransport.build(s, height, width, **options)


def picture(transport, image):
    return transport.apply(mi.TensorXf(image)).numpy()


def references(s, image, spp=256, depth=DEPTH):
    return np.stack([s.render(image, spp=spp, seed=100 + k, max_depth=depth) for k in range(SEEDS)])


def black():
    return np.zeros((HEIGHT, WIDTH, 3), np.float32)


def dot(a, b):
    return (np.asarray(a, np.float64) * np.asarray(b, np.float64)).sum()


def one_hot(texel):
    image = np.zeros((HEIGHT * WIDTH, 3), np.float32)
    image[texel] = 1
    return image.reshape(HEIGHT, WIDTH, 3)
