"""What a GPU does beside the CPU of the same machine: ``experiments/gpu.sh OUT.json``.

Five steps, for ``cuda_ad_rgb`` first and then for ``llvm_ad_rgb``, in at most 8 minutes:

- ``doctor``: the self test of ``envedit doctor``.
- ``quickstart``: ``envedit run quickstart``, with T not from disk.
- ``engine``: T E, T' I and a step, a step of ``prb``, and a step of the standard preset's network
  (``experiments engine``: ``transport-sphere`` and ``siren-standard``).
- ``solver``: an edit of 128x128 pixels and a map of 256x128 by Gauss-Newton, the second of two runs.
- ``fit``: the paper's R-SIREN at its size, 256x128 texels, after three epochs that compile its kernels; on
  the CPU a thirtieth of the epochs.

Needs no data: the map is the analytic sky.
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
EPOCHS, CPU_EPOCHS = 1500, 50
"""Of the paper's fit, and how many of them are measured on the CPU."""
STEPS = ("doctor", "quickstart", "engine", "solver", "fit")


def commands(step: str, variant: str, folder: str, small: bool) -> list[list[str]]:
    """Return the commands of a step, one after the other; the last one is measured, the others warm up."""
    python = [sys.executable, "-m"]
    variable = ["--set", f"variant={variant}"]
    run = [*python, "envedit", "run", "--json", "--quiet", "--out", folder, *variable]
    sizes = ["--set", f"input.width={32 if small else 256}", "--set", f"scene.width={16 if small else 128}"]
    if step == "doctor":
        return [[*python, "envedit", "doctor", "--variant", variant]]
    if step == "quickstart":
        return [[*run, "quickstart", "--set", "renderer.cache=false", *(sizes if small else [])]]
    if step == "engine":
        chosen = ["--only", "siren-standard", "transport-sphere", "--out", folder]
        return [[*python, "experiments", "engine", "run", *chosen, *variable, *["--quick"] * small]]
    if step == "solver":
        edit = ["sphere", "--envmap", "sunsky", "--rotate", "60", "--set", "representation.turn=false"]
        return 2 * [[*run, *edit, *sizes]]
    epochs = 6 if small else CPU_EPOCHS if variant == CPU else EPOCHS
    fit = [*python, "envedit", "fit", "sunsky", "--preset", "paper", "--out", folder, *variable, *sizes[:2]]
    fit += ["--set", "fit.cache=false"]
    return [[*fit, "--set", f"fit.epochs={count}"] for count in (3, epochs)]


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


def measured(step: str, variant: str, left: float, small: bool = False) -> dict[str, Any]:
    """Carry out a step within seconds; a failure is an ``error`` among what was measured.

    ``small``: at tiny sizes, to test this program.
    """
    end = time.monotonic() + left
    with tempfile.TemporaryDirectory() as folder:
        for command in commands(step, variant, folder, small):
            begun = time.perf_counter()
            try:
                rest = max(end - time.monotonic(), 0)
                ran = subprocess.run(command, capture_output=True, text=True, timeout=rest)
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
