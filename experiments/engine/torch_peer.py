"""One step of the same networks in PyTorch on the same cores; run by ``network.py`` in another interpreter.

Imports PyTorch and nothing else that has to be installed. Argument: JSON with ``hidden``, ``depth``,
``shape``, ``omega`` and ``threads``; prints one line of JSON.
"""

import json
import statistics
import sys
import time

import torch

REPEATS, WARM_UP = 11, 3


def siren(hidden, depth, omega):
    """Return a SIREN of the package's architecture: layers, and the function that evaluates them."""
    sizes = [2] + [hidden] * (depth + 1) + [3]
    layers = [torch.nn.Linear(a, b) for a, b in zip(sizes[:-1], sizes[1:], strict=True)]
    with torch.no_grad():
        for i, layer in enumerate(layers):
            bound = 1 / layer.in_features if i == 0 else (6 / layer.in_features) ** 0.5 / omega
            layer.weight.uniform_(-bound, bound)

    def evaluate(h):
        for layer in layers[:-1]:
            h = torch.sin(omega * layer(h))
        return torch.sigmoid(layers[-1](h))

    return layers, evaluate


def main():
    """Measure and print."""
    job = json.loads(sys.argv[1])
    torch.set_num_threads(job["threads"])
    torch.manual_seed(0)
    height, width = job["shape"]
    y = (2 * torch.arange(height) + 1) / height - 1
    x = (2 * torch.arange(width) + 1) / width - 1
    points = torch.stack(torch.meshgrid(y, x, indexing="ij"), dim=-1).reshape(-1, 2)
    layers, evaluate = siren(job["hidden"], job["depth"], job["omega"])
    params = [p for layer in layers for p in layer.parameters()]
    taken = []
    for _ in range(WARM_UP + REPEATS):
        start = time.perf_counter()
        value = evaluate(points)
        torch.autograd.grad(value, params, torch.ones_like(value))
        taken.append(time.perf_counter() - start)
    about = {"version": torch.__version__, "threads": torch.get_num_threads()}
    print(json.dumps(about | {"median_s": statistics.median(taken[WARM_UP:])}))


if __name__ == "__main__":
    main()
