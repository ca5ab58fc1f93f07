"""Record trajectories of PyTorch's Adam and learning rates of its warm restarts.

The package and its tests hold no PyTorch; this script does, in an environment of its own:

    python -m venv torchenv && torchenv/bin/pip install torch==2.13.0 numpy
    torchenv/bin/python experiments/references/make_adam_reference.py tests/data/adam_reference.npz

The file holds, for each gradient scale, the gradients of 200 steps and the parameters after chosen steps.
"""

import sys

import numpy as np
import torch

SHAPES = {"weight": (3, 4), "bias": (5,), "texels": (2, 3, 3)}
SCALES = {"one": 1.0, "small": 1e-6, "large": 1e6}
STEPS = 200
KEPT = [1, 2, 3, 10, 50, 100, 200]


def gradients(rng, scale):
    """Draw gradients with a drift, so that moments neither vanish nor settle."""
    drift = {name: rng.normal(size=shape) for name, shape in SHAPES.items()}
    return {
        name: (
            scale
            * (
                drift[name] * np.cos(0.05 * np.arange(STEPS)).reshape(-1, *[1] * len(shape))
                + rng.normal(size=(STEPS, *shape))
            )
        ).astype(np.float32)
        for name, shape in SHAPES.items()
    }


def rates(lr, steps, schedule, **options):
    """List the learning rates of some steps under a schedule."""
    sgd = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=lr)
    scheduler = schedule(sgd, **options)
    found = []
    for _ in range(steps):
        found.append(sgd.param_groups[0]["lr"])
        sgd.step()
        scheduler.step()
    return np.array(found)


def main(path):
    rng = np.random.default_rng(20240917)
    record = {"kept": np.array(KEPT), "lr": np.float64(1e-2)}
    for label, scale in SCALES.items():
        start = {name: rng.normal(size=shape).astype(np.float32) for name, shape in SHAPES.items()}
        grads = gradients(rng, scale)
        leaves = {name: torch.tensor(value, requires_grad=True) for name, value in start.items()}
        adam = torch.optim.Adam(leaves.values(), lr=1e-2, betas=(0.9, 0.999), eps=1e-8, foreach=False)
        trace = {name: [] for name in SHAPES}
        for step in range(STEPS):
            for name, leaf in leaves.items():
                leaf.grad = torch.tensor(grads[name][step])
            adam.step()
            if step + 1 in KEPT:
                for name, leaf in leaves.items():
                    trace[name].append(leaf.detach().numpy().copy())
        for name in SHAPES:
            record[f"{label}/start/{name}"] = start[name]
            record[f"{label}/grad/{name}"] = grads[name]
            record[f"{label}/trace/{name}"] = np.stack(trace[name])

    schedules = torch.optim.lr_scheduler
    record["warm_restarts"] = rates(5e-5, 350, schedules.CosineAnnealingWarmRestarts, T_0=100)
    record["cosine"] = rates(2e-3, 61, schedules.CosineAnnealingLR, T_max=60, eta_min=1e-5)
    np.savez_compressed(path, **record)
    print(f"torch {torch.__version__}: {path}")


if __name__ == "__main__":
    main(sys.argv[1])
