"""Estimate an environment map by Adam on its texels: by path tracing, and by stored transport.

The loop is that of Mitsuba's tutorial: a constant map of radiance 1, the mean squared error of linear
pictures, Adam with a learning rate of 0.02. Only what renders the picture differs.
"""

import time

import drjit as dr
import mitsuba as mi
import numpy as np

from envedit import inputs
from envedit.core.color import tonemap
from envedit.images import images
from envedit.images.analytic_sky import sunsky
from envedit.losses import metrics
from envedit.scene.path_tracer import PathTracer
from envedit.transport.light_transport import LightTransport
from experiments.harness import Experiment, calling, figure

WIDTH = 32
"""Texels across the map, and pixels across the picture."""
STEPS = 800
RATE = 0.02
"""Learning rate of the tutorial."""
DEPTH = 6
TARGET_SPP = 4096
JUDGE_SPP = 512
JUDGED_EVERY = 25
SHOWN = 50, 200, STEPS
"""Steps whose maps are kept for the figure."""
FRESH = 1_000_000
"""Steps from here on give seeds that no step of an optimisation has."""
METHODS = {
    "path tracing, 1 sample": {"spp": 1},
    "path tracing, 16 samples": {"spp": 16},
    "path tracing, 16 samples, map at least 0": {"spp": 16, "least": 0.0},
    "stored transport": {"spp": 0},
}


def estimate(settings, folder, spp, least=None) -> dict:
    """Estimate the sky from its rendering, by ``spp`` samples a pixel of a step; 0: stored transport.

    ``least`` is the least radiance that a step may lead to. Returns ``losses`` of every step, ``judged``:
    rows of :func:`judge`, ``step_s``: median seconds of a step.
    """
    scene = inputs.load_scene(settings.scene)
    true = sky()
    target = mi.TensorXf(path_tracing(scene, TARGET_SPP)(mi.TensorXf(true), FRESH).numpy())
    if spp:
        render = path_tracing(scene, spp)
    else:
        height, width, _ = true.shape
        transport = LightTransport.build(scene, height, width, max_depth=DEPTH, seed=settings.seed)

        def render(envmap, step):
            return transport.apply(envmap)

    adam = mi.ad.Adam(lr=settings.optimizer.lr)
    adam["map"] = mi.TensorXf(np.ones_like(true))
    steps = settings.optimizer.iterations
    losses = []
    judged = []
    seconds = []
    for step in range(steps + 1):
        if step % JUDGED_EVERY == 0 or step == steps:
            judged.append({"step": step, **judge(scene, render, dr.detach(adam["map"]), true, target)})
        if step in (*SHOWN, steps):
            images.write_exr(folder / f"map_{step}.exr", adam["map"].numpy())
        if step < steps:
            began = time.perf_counter()
            loss = squared_error(render(adam["map"], step), target)
            dr.backward(loss)
            adam.step()
            if least is not None:
                adam["map"] = dr.maximum(adam["map"], least)
            losses.append(float(loss.array[0]))
            seconds.append(time.perf_counter() - began)
    return {"losses": losses, "judged": judged, "step_s": float(np.median(seconds))}


def sky() -> np.ndarray:
    """Return the map to be found: Mitsuba's analytic sky without its sun, mean radiance 1."""
    radiance = sunsky(WIDTH, azimuth=230, elevation=40, sun_scale=0)
    return radiance / radiance.mean()


def path_tracing(scene, spp):
    """Return (map (H, W, 3), step) -> picture: Mitsuba's ``prb``, other seeds for its gradients."""
    return PathTracer(scene, spp, DEPTH, one_thread=False).render


def squared_error(picture, target):
    """Return the mean squared error of linear pictures."""
    return dr.mean(dr.square(picture - target), axis=None)


def judge(scene, render, envmap, true, target, first=FRESH) -> dict:
    """Judge a map by Mitsuba, and the noise of what renders it, with the seeds of steps from ``first``.

    Returns ``loss``: mean product of the errors of two independent renderings, which their variance does not
    bias; ``variance`` of the pictures of a step, mean over pixels; ``noise``: of the squared length of a
    step's gradient, the share that two gradients of the same map do not have in common; ``psnr`` of the upper
    half of the map, as the ground hides the other; ``least`` radiance of the map.
    """
    reference = path_tracing(scene, JUDGE_SPP)
    one, other = (reference(envmap, first + k).numpy() - target.numpy() for k in (1, 2))
    pictures = []
    gradients = []
    for k in (3, 4):
        leaf = mi.TensorXf(envmap)
        dr.enable_grad(leaf)
        picture = render(leaf, first + k)
        dr.backward(squared_error(picture, target))
        pictures.append(picture.numpy())
        gradients.append(dr.grad(leaf).numpy().astype(float))
    g, h = gradients
    return {
        "loss": float(np.mean(one * other, dtype=float)),
        "variance": float(np.mean((pictures[0] - pictures[1]) ** 2, dtype=float) / 2),
        "noise": 1 - 2 * np.sum(g * h) / np.sum(g**2 + h**2),
        "psnr": metrics.psnr(envmap.numpy()[: len(true) // 2], true[: len(true) // 2], float(true.max())),
        "least": float(envmap.numpy().min()),
    }


def cases(given):
    tables = {"scene": {"file": "sphere", "width": WIDTH}, "optimizer": {"lr": RATE, "iterations": STEPS}}
    return [calling(name, estimate, tables, {"method": name}, **how) for name, how in METHODS.items()]


def measure(done) -> dict:
    losses = np.array(done.metrics["losses"])
    judged = done.metrics["judged"]
    smooth = np.convolve(losses, np.ones(JUDGED_EVERY) / JUDGED_EVERY, "valid")
    best = max(judged, key=lambda row: row["psnr"])
    return {
        "lowest": smooth.min(),
        "at": int(smooth.argmin()) + JUDGED_EVERY // 2,
        "last": smooth[-1],
        "best": best["psnr"],
        "best_at": best["step"],
        "step_s": done.metrics["step_s"],
        "end": judged[-1],
    }


def combine(rows):
    """Give seconds as multiples of the transport's."""
    least = min(row["step_s"] for row in rows)
    return [row | {"ratio": row["step_s"] / least} for row in rows]


def draw(done, to):
    """Draw losses and map over steps, and the maps of some steps below: ``divergence.png``."""
    titles = {"loss": "loss, judged by Mitsuba", "psnr": "map PSNR, dB", "noise": "noise of the gradient"}
    ratios = [3.4, *[1] * len(done)]
    size = 11, 3.4 + 0.95 * len(done)
    with figure(to / "divergence.png", 1 + len(done), 4, size, height_ratios=ratios) as panels:
        for row, one in enumerate(done, 1):
            judged = one.metrics["judged"]
            label = one.case.name.removeprefix("path tracing, ")
            steps = [point["step"] for point in judged]
            panels[0, 0].plot(one.metrics["losses"], linewidth=0.8)
            for panel, key in zip(panels[0, 1:], titles, strict=True):
                panel.plot(steps, [point[key] for point in judged], label=label)
            shown = {f"step {step}": one.picture(f"map_{step}") for step in (*SHOWN[:2], steps[-1])}
            for panel, (name, image) in zip(panels[row], {**shown, "true map": sky()}.items(), strict=True):
                colours = tonemap(image / 3, "gamma")
                colours[image.min(axis=2) < 0] = 1, 0, 1
                panel.imshow(colours[: len(image) // 2], interpolation="nearest")
                panel.set(xticks=[], yticks=[], xlabel=name)
            panels[row, 0].set_title(one.case.name, loc="left", fontsize="small")
        for panel, title in zip(panels[0], ("loss of the step", *titles.values()), strict=True):
            panel.set(xlabel="steps", title=title, yscale="log" if "loss" in title else "linear")
        panels[0, 1].legend(fontsize="xx-small")
    return [to / "divergence.png"]


EXPERIMENT = Experiment(
    cases,
    measure,
    {
        "method": "{method}",
        "lowest loss of a step": "{lowest:.2g} at {at}",
        "last": "{last:.2g}",
        "variance": "{end[variance]:.2g}",
        "judged loss": "{end[loss]:.2g}",
        "noise of the gradient": "{end[noise]:.1%}",
        "best map, dB": "{best:.1f} at {best_at}",
        "last map, dB": "{end[psnr]:.1f}",
        "its least radiance": "{end[least]:.1f}",
        "seconds a step, ratio": "{ratio:.0f}",
    },
    combine=combine,
    draw=draw,
    alone=True,
)
