"""What a GPU does beside the CPU of the same machine: ``experiments/gpu.sh OUT.json``.

Five steps for ``cuda_ad_rgb`` and then for ``llvm_ad_rgb``, in at most 8 minutes, without data: the map is
the analytic sky. *solver* is an edit by Gauss-Newton, *fit* the paper's R-SIREN at its size.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from envedit.core.atomic_files import write_atomically

GPU, CPU = "cuda_ad_rgb", "llvm_ad_rgb"
MINUTES = 8
EPOCHS = {GPU: 1500, CPU: 50}
"""How many of the paper's epochs are measured."""
SIZES = "--set input.width=256 --set scene.width=128"
RUN = "envedit run --json --quiet --out {folder} --set variant={variant}"
FIT = "envedit fit sunsky --preset paper --out {folder} --set variant={variant} --set fit.cache=false {sizes}"
STEPS = {
    "doctor": ["envedit doctor --variant {variant}"],
    "quickstart": [f"{RUN} quickstart --set renderer.cache=false"],
    "engine": [
        "experiments engine run --only siren-standard transport-sphere --out {folder} --set variant={variant}"
    ],
    "solver": 2 * [f"{RUN} sphere --envmap sunsky --rotate 60 --set representation.turn=false {{sizes}}"],
    "fit": [f"{FIT} --set fit.epochs=3", f"{FIT} --set fit.epochs={{epochs}}"],
}
"""Commands of each step, one after the other; the last one is measured, the others warm up."""


def result(step: str, folder: str, printed: str) -> dict[str, Any]:
    """Return the numbers of a step that ended well."""
    if step == "doctor":
        return {"said": printed.strip().splitlines()}
    if step == "engine":
        found = {}
        for file in Path(folder).glob("*/result.json"):
            found |= json.loads(file.read_text())["tables"]
        return found
    if step == "fit":
        return json.loads((Path(folder) / "fit.json").read_text())
    metrics = json.loads(printed)["metrics"]
    quality = {name: metrics[name] and metrics[name]["psnr"] for name in ("initial", "render", "envmap")}
    return {"psnr": quality, "iterations": metrics["iterations"], "timing": metrics["timing"]}


def measured(step: str, variant: str, left: float) -> dict[str, Any]:
    """Carry out a step within seconds; a failure is an ``error`` among what was measured."""
    end = time.monotonic() + left
    with tempfile.TemporaryDirectory() as folder:
        for command in STEPS[step]:
            begun = time.perf_counter()
            line = command.format(
                folder=folder, variant=variant, sizes=SIZES, epochs=EPOCHS.get(variant)
            ).split()
            try:
                ran = subprocess.run(
                    [sys.executable, "-m", *line],
                    capture_output=True,
                    text=True,
                    timeout=max(end - time.monotonic(), 0),
                )
            except subprocess.TimeoutExpired:
                return {"error": f"not done after {left:.0f} s"}
            if ran.returncode:
                lines = (ran.stderr or ran.stdout).strip().splitlines() or ["no message"]
                return {"error": f"exit code {ran.returncode}: {'; '.join(lines[-2:])[:300]}"}
        return result(step, folder, ran.stdout) | {"wall_s": time.perf_counter() - begun}


def machine() -> dict[str, Any]:
    """Describe the machine: system, cores, and GPUs as the NVIDIA driver names them."""
    gpus = None
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
        gpus = subprocess.run(query, capture_output=True, text=True, timeout=20).stdout.splitlines()
    return {"system": platform.platform(), "cores": os.cpu_count(), "gpus": gpus}


def main(argv: list[str] | None = None) -> int:
    """Measure, and write a file after every step; returns the exit code: 0, 1 if a step of the GPU failed."""
    given = sys.argv[1:] if argv is None else argv
    if len(given) != 1:
        print("usage: experiments/gpu.sh OUT.json", file=sys.stderr)
        return 2
    end = time.monotonic() + 60 * MINUTES
    steps: dict[str, dict[str, Any]] = {step: {} for step in STEPS}
    found = {"machine": machine(), "minutes": MINUTES, "steps": steps}
    failed = False
    for variant in (GPU, CPU):
        for step in STEPS:
            if step != "doctor" and "error" in steps["doctor"][variant]:
                continue
            one = measured(step, variant, end - time.monotonic())
            steps[step][variant] = one
            failed |= "error" in one and variant == GPU
            write_atomically(Path(given[0]), json.dumps(found, indent=1).encode())
            print(f"{variant} {step}: {one.get('error') or format(one['wall_s'], '.1f') + ' s'}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
