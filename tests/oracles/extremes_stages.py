"""What is done in a cell of the matrix of extremes: a map through one stage, compared with plain float64.

A stage returns normally where all that it made is finite and correct, and raises where the map is refused.
"""

import functools

import numpy as np
import OpenEXR

from envedit import config, representations
from envedit.core import latlong
from envedit.images import images
from envedit.losses import metrics
from envedit.renderers import StoredRenderer
from envedit.representations.layers.layers import Layers
from envedit.scene import scene
from envedit.solve import adam_loop, search
from envedit.solve.map_problem import Problem
from envedit.transport.light_transport import LightTransport
from tests.oracles.builders import floats
from tests.oracles.plain import IDENTICAL, single

FILM = (8, 6)
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
STEPS = 25
"""Of the edit loop; it stops at the 20th that is not finite in a row."""


# ---- what stages share -----------------------------------------------------------------------------------


def sky(height: int = 16, width: int = 32) -> np.ndarray:
    """Return a smooth sky between 0.07 and 0.7."""
    row, column = np.mgrid[:height, :width]
    base = 0.4 + 0.3 * np.cos(2 * np.pi * (column + 0.5) / width) * np.sin(np.pi * (row + 0.5) / height)
    return (base[..., None] * [1.0, 0.9, 0.7]).astype(np.float32)


def close(got, wanted, relative: float, absolute: float = 0.0) -> None:
    """Compare an array with its reference: errors at most ``relative`` of the largest reference value."""
    got, wanted = np.asarray(got, np.float64), np.asarray(wanted, np.float64)
    assert got.shape == wanted.shape
    error = np.abs(got - wanted).max()
    assert error <= relative * np.abs(wanted).max() + absolute, f"off by {error:g}"


@functools.cache
def matte() -> scene.Scene:
    return scene.load("matte", *FILM)


@functools.cache
def transport(height: int, width: int) -> LightTransport:
    """Trace T of the scene, with exact columns where maps of the matrix have their suns."""
    traced = LightTransport.build(matte(), height, width, spp=16, max_depth=3)
    if (height, width) == (16, 32):
        return traced.with_probed(np.array([0 * 32 + 7, 5 * 32, 7 * 32 + 20, 5 * 32 + 9]))
    return traced


# ---- reading, checking, writing --------------------------------------------------------------------------


def read(m, folder):
    """Every finite value as stored, negative ones as 0 with a warning; no other texel is touched."""
    if m.shape[1] == 4096:  # whole: files must be 2:1
        m = np.ascontiguousarray(np.broadcast_to(m[8], (2048, 4096, 3)))
    path = floats(folder / "map.exr", m)
    wrong = ~np.isfinite(m).all(axis=2)
    if wrong.any() and not wrong.all():  # what is refused below can be asked to be mended
        mended, info = images.load_envmap(path, repair=True)
        np.testing.assert_array_equal(mended[~wrong], m[~wrong])
        near = m[4:7, 8:11].reshape(9, 3)[[0, 1, 2, 3, 5, 6, 7, 8]]
        sun = np.isposinf(m[5, 9]).any()  # overflowed
        expected = 65504 if sun else near.mean(axis=0, dtype=np.float64)
        np.testing.assert_allclose(mended[5, 9], expected, rtol=1e-6)
        assert info["repaired"] == 1
    found, info = images.load_envmap(path)
    np.testing.assert_array_equal(found, np.maximum(m, 0))
    expected = [
        w
        for w, said in (
            ("negative", (m < 0).any()),
            ("65504, the largest half", (m == 65504).any()),
            ("black", not (m > 0).any()),
        )
        if said
    ]
    assert len(info["warnings"]) == len(expected)
    assert all(word in line for word, line in zip(expected, info["warnings"], strict=True))


def write(m, folder):
    """The file holds every bit; a map that is not finite reaches no file."""
    path = folder / "out.exr"
    path.unlink(missing_ok=True)
    try:
        images.write_exr(path, m)
    finally:
        assert path.exists() == np.isfinite(m).all()
    pixels = OpenEXR.File(str(path)).parts[0].channels["RGB"].pixels
    np.testing.assert_array_equal(np.asarray(pixels).view(np.uint32), m.view(np.uint32))


# ---- functions of the map --------------------------------------------------------------------------------


def fitted(m, folder):
    """A few steps: finite weights, a map within the range that the network has, a loss that does not rise."""
    told = []
    recipe = config.Fit(epochs=21, lr=5e-3, awp_gamma=0.01, cache=False, polish="always")
    network = config.Representation(hidden=12, depth=1)
    made = representations.Siren(network, recipe, progress=lambda done, total, loss: told.append(loss))
    params = made.encode(m)
    assert all(np.isfinite(value.numpy()).all() for value in params.values())
    got = made.decode(params).numpy()
    normal = made.fitted.normalisation
    assert np.isfinite(got).all() and got.min() >= 0
    assert np.log(got.max(initial=0) + 0.01) <= normal.low + normal.span + 1e-3
    assert len(told) == 2 and np.isfinite(told).all() and told[1] <= told[0]


# ---- the loop --------------------------------------------------------------------------------------------


def renderer(height, width):
    """Return a renderer through T without columns."""
    return StoredRenderer(_traced(height, width))


@functools.cache
def _traced(height, width):
    return LightTransport.build(matte(), height, width, spp=16, max_depth=3, few=True)


def edited(m, folder):
    """Layers towards the turned map: lights are searched for; finite, no step lost, a lower loss.

    Where the turned map is the same map, not one bit changes in the loop.
    """
    height, width, _ = m.shape
    made = Layers.of(m, cycles=4)
    params = made.start()
    traced = renderer(height, width)
    turned = latlong.rotate(m, 90.0)
    same = np.array_equal(turned, m)
    settle(traced, m, turned)
    wanted = traced.transport.apply(single(turned)).numpy()
    if not same:
        problem = Problem(made, traced.transport, m, wanted)
        lights = search.search(problem, problem.state(params))
        assert np.isfinite(made.decode(problem.solution_params(lights.run.state)).numpy()).all()
    weights = config.Loss(ssim=0.1, image_l1=1.0, image_l2=1.0)
    objective = adam_loop.Objective(weights, wanted, np.ones_like(wanted[..., :1]), m, STEPS)
    settings = config.Optimizer(iterations=STEPS, lr=0.003)
    start = made.decode(params).numpy()
    params, state = adam_loop.optimise(made, params, traced, objective, m, 0, settings)
    got = made.decode(params).numpy()
    assert np.isfinite(got).all() and (got >= 0).all() and state.bad_steps == 0
    if same:
        np.testing.assert_array_equal(got, m)
        assert state.history[-1]["loss"] == 0
    else:
        settle(traced, start, got)
        after, before = (
            float(objective(traced.transport.apply(single(e)), single(e), 0)[0][0]) for e in (got, start)
        )
        assert after < before


def settle(traced, *maps):
    """Take the columns that maps ask for: afterwards T is the same for them at every step."""
    for m in maps:
        traced.transport = traced.transport.resolved(m)


# ---- metrics ---------------------------------------------------------------------------------------------


def judged(m, folder):
    """Every number is plain float64's to 1e-9, finite or null; a map against itself is 200 dB, 1 and 0."""
    other = sky(*m.shape[:2])
    same = metrics.compare(m, m)
    assert same == IDENTICAL
    assert metrics.log_psnr(m, m) == 200 and metrics.sun_offset(m, m) == 0
    a, b = (np.clip(e.astype(np.float64), 0, 1) ** (1 / 2.2) for e in (m, other))
    found, mse = metrics.compare(m, other), np.mean((a - b) ** 2)
    np.testing.assert_allclose([found["mse"], found["psnr"]], [mse, -10 * np.log10(mse)], rtol=1e-6)
    assert -1 <= found["ssim"] < 1
    logs = [np.log(np.maximum(e.astype(np.float64), 0) + 0.01) for e in (m, other)]
    wanted = 20 * np.log10(np.ptp(logs[1])) - 10 * np.log10(np.mean((logs[0] - logs[1]) ** 2))
    np.testing.assert_allclose(metrics.log_psnr(m, other), wanted, rtol=1e-9)
    y, z = m.astype(np.float64) @ LUMINANCE, other.astype(np.float64) @ LUMINANCE
    np.testing.assert_allclose(metrics.peak_ratio(m, other), y.max() / z.max(), rtol=1e-9)
    np.testing.assert_allclose(metrics.mean_luminance_ratio(m, other), y.mean() / z.mean(), rtol=1e-9)
    assert metrics.peak_position(m) == np.unravel_index(y.argmax(), y.shape)
    assert 0 <= metrics.high_frequency_energy(m) < np.inf


STAGES = {
    "read": read,
    "fit": fitted,
    "edit loop": edited,
    "write": write,
    "metrics": judged,
}
"""Name of a stage -> what is done; docstrings say what is correct."""
