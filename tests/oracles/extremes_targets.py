"""Targets and scenes as odd as they can be: what is asked, what is done, and what happens."""

import functools

import mitsuba as mi
import numpy as np

from envedit import config, representations
from envedit.core.errors import InputError, NumericalError
from envedit.losses import display_curve, metrics, optimizer
from envedit.renderers import StoredRenderer
from envedit.scene import scene
from envedit.solve import adam_loop
from envedit.targets import painted_image
from envedit.transport.light_transport import LightTransport
from tests.oracles.builders import floats
from tests.oracles.extremes_stages import (
    FILM,
    Outcome,
    close,
    loss_and_gradient,
    matte,
    plain,
    refused,
    settle,
    single,
    sky,
    ssim_rounding,
    transport,
)
from tests.oracles.plain import IDENTICAL

SHAPE = (FILM[1], FILM[0])
STEPS = 10
"""After so many a transport looks for texels that have grown bright: until then T is the same."""


@functools.cache
def initial():
    return transport(16, 32).apply(single(sky())).numpy()


def traced():
    return StoredRenderer(LightTransport.build(matte(), 16, 32, spp=16, max_depth=3))


def edited(picture, weight=None, steps=STEPS, renderer=None, **more):
    """Edit the logarithms of the map of the matrix towards a picture; returns map and state of the loop."""
    made, before = representations.LogPixels(), sky()
    objective = adam_loop.Objective(config.Loss(image_l2=1.0), picture, weight, before, steps)
    settings = config.Optimizer(iterations=steps, lr=0.02)
    params, state = adam_loop.optimise(
        made, made.encode(before), renderer or traced(), objective, before, 0, settings, **more
    )
    return made.decode(params).numpy(), state


def follow(picture, weight=None):
    """Edit the map; the loss falls, and all stays finite."""
    got, state = edited(picture, weight)
    assert np.isfinite(got).all() and (got >= 0).all() and state.bad_steps == 0
    assert state.history[-1]["loss"] < state.history[0]["loss"]
    return got


def _even(value):
    """Ask for one value in every pixel."""

    def act(folder):
        picture = np.full((*SHAPE, 3), value, np.float32)
        found = painted_image.given(picture, SHAPE, initial())
        np.testing.assert_array_equal(found.picture, np.maximum(picture, 0))
        assert (found.coverage == 1).all()
        shown = [display_curve.to_display(single(e)).numpy() for e in (initial(), found.picture)]
        for name in ("image_l1", "image_l2", "ssim"):
            for got, wanted in zip(loss_and_gradient(name, *shown), plain(name, *shown), strict=True):
                close(got, wanted, 1e-5, ssim_rounding(np.maximum(*shown)) if name == "ssim" else 0)
        got = follow(found.picture)
        light = got.sum(dtype=np.float64) - sky().sum(dtype=np.float64)
        assert light < 0 if value <= 0 else light > 0
        judged = metrics.compare(initial(), found.picture)
        a, b = (np.clip(e.astype(np.float64), 0, 1) ** (1 / 2.2) for e in (initial(), found.picture))
        np.testing.assert_allclose(judged["mse"], np.mean((a - b) ** 2), rtol=1e-6)

    return act


def _one(value):
    """Ask for one value in one pixel, and for the rest as it is."""

    def act(folder):
        picture = initial().copy()
        picture[2, 3] = value
        found = painted_image.given(picture, SHAPE, initial())
        assert found.coverage.sum() == 1 and found.coverage[2, 3] == 1
        follow(found.picture)

    return act


def _unchecked(value):
    """Put a pixel that is not finite past all checks, into the loop."""

    def act(folder):
        picture = initial().copy()
        picture[2, 3] = value
        params = representations.LogPixels().encode(sky())
        start = {name: array.numpy() for name, array in params.items()}
        held = optimizer.Adam(params, 0.02)
        try:
            edited(picture, steps=21, adam=held)  # it stops at the 20th bad step
        finally:
            for name, array in start.items():
                np.testing.assert_array_equal(held.params[name].numpy(), array)

    return act


def _equal(folder):
    painted_image.given(initial(), SHAPE, initial())


def _equal_in_the_loop(folder):
    made, renderer = representations.LogPixels(), traced()
    start = made.decode(made.encode(sky())).numpy()
    settle(renderer, start)
    picture = renderer.transport.apply(single(start)).numpy()
    got, state = edited(picture, renderer=renderer)
    np.testing.assert_array_equal(got, start)
    assert state.history[-1]["loss"] == 0
    assert metrics.compare(picture, picture) == IDENTICAL


def _transparent(alpha, light=2.0):
    """Paint light times the rendering, with alpha, in an OpenEXR file."""

    def act(folder):
        paint = alpha * light * initial()
        path = floats(folder / "p.exr", paint, A=np.full(SHAPE, alpha, np.float32))
        found = painted_image.read(path, SHAPE, "gamma", initial())
        np.testing.assert_allclose(found.coverage, alpha, rtol=1e-6)
        mixed = (alpha * light + 1 - alpha) * initial().astype(np.float64)
        np.testing.assert_allclose(found.picture, mixed, rtol=1e-5)

    return act


def _clipped(share):
    """Paint white into a part of an 8-bit picture, and a grey into the rest."""

    def act(folder):
        codes = np.full((*SHAPE, 3), 128, np.uint8)
        codes.reshape(-1, 3)[: round(share * SHAPE[0] * SHAPE[1])] = 255
        mi.Bitmap(codes).write(str(folder / "p.png"))
        found = painted_image.read(folder / "p.png", SHAPE, "gamma", initial())
        white = (codes == 255).all(axis=2)
        np.testing.assert_array_equal(found.excluded, white)
        assert any(f"{white.sum()} painted pixels are clipped" in line for line in found.warnings)
        np.testing.assert_allclose(found.picture[~white], (128 / 255) ** 2.2, rtol=1e-6)
        follow(found.picture, (~white[..., None]).astype(np.float32))

    return act


def _not_finite_file(folder):
    picture = initial().copy()
    picture[2, 3, 1] = np.nan
    painted_image.read(floats(folder / "p.exr", picture), SHAPE, "gamma", initial())


def done(says):
    return Outcome("done", says)


NOT_FINITE = refused(
    InputError, "target: pixel at row 2, column 3 is not finite: repair it where it comes from"
)
TARGETS = {
    "all black": (_even(0.0), done("Followed: light is taken away, the loss falls.")),
    "all white": (_even(1.0), done("Followed: light is added, the loss falls.")),
    "all 65504": (_even(65504.0), done("Followed, as above.")),
    "all 3e38": (
        _even(3e38),
        done(
            "Followed: display values go on as a logarithm above 1, so that the loss is 40 and not infinite."
        ),
    ),
    "one pixel of 1e30": (_one(1e30), done("Followed; all other pixels count as not painted.")),
    "one pixel of -5": (_one(-5.0), done("As 0: nothing is darker than black.")),
    "NaN, given as an array": (_one(np.nan), NOT_FINITE),
    "+Inf, given as an array": (_one(np.inf), NOT_FINITE),
    "NaN, in a file": (
        _not_finite_file,
        refused(
            InputError, "p.exr: pixel at row 2, column 3 is not finite: repair it in the program it came from"
        ),
    ),
    "NaN, past all checks in the loop": (
        _unchecked(np.nan),
        refused(NumericalError, "not finite", "No step is taken: the map stays as it was."),
    ),
    "painted, and equal to the initial rendering": (
        _equal,
        refused(InputError, "target: nothing of the picture is painted"),
    ),
    "equal to the initial rendering, in the loop": (
        _equal_in_the_loop,
        done("Loss and gradient are 0: no bit of the map changes."),
    ),
    "alpha 0 everywhere": (_transparent(0.0), refused(InputError, "p.exr: nothing of it is painted")),
    "alpha 1e-4, twice as bright": (
        _transparent(1e-4),
        refused(
            InputError,
            "p.exr: nothing of it is painted",
            "It adds less than a half float rounds by, and cannot be distinguished from a file's rounding.",
        ),
    ),
    "alpha 1e-4, 1000 times as bright": (
        _transparent(1e-4, 1e3),
        done("Coverage 1e-4, colours laid over the rendering."),
    ),
    "alpha 1": (_transparent(1.0), done("Coverage 1, the colours as painted.")),
    "8-bit picture, half of it white": (
        _clipped(0.5),
        done(
            "Clipped pixels say only 'at least so bright': left out with a warning, the others are followed."
        ),
    ),
    "8-bit picture, all of it white": (
        _clipped(1.0),
        refused(InputError, "p.png: all that is painted is clipped, and says only 'at least so bright'"),
    ),
}
"""Name -> (what is done, how it ends)."""

# ---- scenes ----------------------------------------------------------------------------------------------


def _rough(alpha):
    """Trace and render the sphere at a roughness: the two pictures have the same light."""

    def act(folder):
        lit = scene.load("sphere", 12, 12, {"roughness": alpha})
        traced = LightTransport.build(lit, 16, 32, spp=64, max_depth=3)
        m = sky()
        got, wanted = traced.apply(single(m)).numpy(), lit.render(m, spp=256, max_depth=3)
        assert np.isfinite(got).all() and (got >= 0).all() and traced.influence.min() >= 0
        # The sphere's own pixels, the middle of the film; both are means of 64 and more paths a pixel.
        for part in (np.s_[:], np.s_[4:9, 4:8]):
            np.testing.assert_allclose(got[part].mean(axis=(0, 1)), wanted[part].mean(axis=(0, 1)), rtol=0.02)
        pulled = traced.adjoint(single(got)).numpy().astype(np.float64)
        close((m * pulled).sum(), np.square(got.astype(np.float64)).sum(), 1e-5)

    return act


def _closed(folder):
    LightTransport.build(_box(), 16, 32, spp=16, max_depth=3)


def _black_everywhere(folder):
    got = _box().render(sky(), spp=16)
    assert not got.any()
    assert metrics.compare(got, got)["psnr"] == 200


@functools.cache
def _box():
    look = mi.ScalarTransform4f().look_at([0, 0, 0.5], [0, 0, -1], [0, 1, 0])
    film = {"type": "hdrfilm", "width": FILM[0], "height": FILM[1]}
    return scene.load(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "to_world": look, "film": film},
            "light": {"type": "constant"},
            "box": {"type": "cube", "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}},
        }
    )


SCENES = {
    "roughness 0": (_rough(0.0), done("A mirror: the same light as Mitsuba's own rendering, within 2 %.")),
    "roughness 1e-4": (_rough(1e-4), done("The same light as Mitsuba's own rendering, within 2 %.")),
    "roughness 1": (_rough(1.0), done("The same light as Mitsuba's own rendering, within 2 %.")),
    "no pixel sees the sky, traced": (
        _closed,
        refused(InputError, "scene dict: no pixel receives light from the environment within path depth 3"),
    ),
    "no pixel sees the sky, rendered": (_black_everywhere, done("Black in every pixel.")),
}
"""Name -> (what is done, how it ends)."""
