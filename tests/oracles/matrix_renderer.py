"""A renderer that is a known matrix, and edits through it."""

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit import config, representations
from envedit.solve import adam_loop

HEIGHT, WIDTH, FILM = 6, 8, (12, 14)


class Matrix:
    """A renderer that is a matrix of pixels by texels; at the steps ``bad`` its picture is not finite."""

    def __init__(self, rng, height=HEIGHT, width=WIDTH, film=FILM, bad=(), value=math.nan):
        self.film, self.bad, self.value = film, bad, value
        pixels, texels = film[0] * film[1], height * width
        # Each pixel sees one texel well and all others a little, so that the picture decides the map.
        weights = 0.2 * rng.random((pixels, texels)) / texels + np.eye(texels)[np.arange(pixels) % texels]
        weights /= weights.sum(axis=1, keepdims=True)
        self.weights = dr.opaque(mi.TensorXf(weights.astype(np.float32)))

    def render(self, env, step):
        texels = dr.reshape(env, (env.shape[0] * env.shape[1], 3))
        gain = dr.opaque(mi.Float, self.value if step in self.bad else 1)
        picture = dr.matmul(self.weights, texels)
        return mi.TensorXf(picture.array * gain, (*self.film, 3))


def sky(rng, height=HEIGHT, width=WIDTH):
    return (0.1 + rng.random((height, width, 3)) ** 3).astype(np.float32)


def matrix_of(renderer, image):
    return renderer.render(mi.TensorXf(image), -1).numpy()


def case(rng, rows=3, iterations=12, weights=None, lr=0.02, schedule="constant", pixel_weight=None, **kwargs):
    """Return what ``optimise`` takes, for the edit of the first rows of a random map."""
    original, true = sky(rng), sky(rng)
    true[rows:] = original[rows:]
    renderer = Matrix(rng, **kwargs)
    weights = weights or config.Loss(ssim=1.0, image_l1=1.0)
    picture = matrix_of(renderer, true)
    if pixel_weight is None:
        pixel_weight = np.ones_like(picture[..., :1])
    objective = adam_loop.Objective(weights, picture, pixel_weight, original[:rows], iterations)
    representation = representations.LogPixels()
    params = representation.encode(original[:rows])
    settings = config.Optimizer(iterations=iterations, lr=lr, schedule=schedule)
    return (representation, params, renderer, objective, original, 0, settings), true


def arrays(params):
    return {name: value.numpy() for name, value in params.items()}


def same(a, b):
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


def same_bits(a, b):
    """Compare arrays by name: their types, shapes and bytes."""
    one, other = (
        {name: (np.asarray(v).dtype, np.shape(v), np.asarray(v).tobytes()) for name, v in found.items()}
        for found in (a, b)
    )
    return one == other


def without_times(history):
    return [{key: value for key, value in row.items() if key != "step_ms"} for row in history]
