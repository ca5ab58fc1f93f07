"""What a GPU does beside the CPU of the same machine: ``experiments/gpu.sh OUT.json``.

Five steps, for the variant first and then for ``llvm_ad_rgb``, each ended when the time is over:

- ``doctor``: the self test of ``envedit doctor``.
- ``quickstart``: ``envedit run quickstart``, with T not from disk.
- ``engine``: T E, T' I and a step, a step of ``prb``, and a step of the standard preset's network
  (``experiments engine``: ``transport-sphere`` and ``siren-standard``).
- ``solver``: an edit of 128x128 pixels and a map of 256x128 by Gauss-Newton, the second of two runs.
- ``fit``: the paper's R-SIREN at its size, 256x128 texels, after three epochs that compile its kernels; on
  the CPU a thirtieth of the epochs.

``--small`` makes all of it tiny, to test this program. Needs no data: the map is the analytic sky.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from envedit.core.atomic_files import write_atomically

CPU = "llvm_ad_rgb"
EPOCHS, CPU_EPOCHS = 1500, 50
"""Of the paper's fit, and how many of them are measured on the CPU."""
STEPS = ("doctor", "quickstart", "engine", "solver", "fit")


def commands(step: str, variant: str, small: bool, folder: str) -> list[list[str]]:
    """Return the commands of a step, one after the other; the last one is measured."""
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


def called(command: list[str], left: float) -> tuple[int | None, str, str]:
    """Run a command; returns its exit code, None if time was over, and what it printed on both streams."""
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, start_new_session=True) as child:
        try:
            printed, errors = child.communicate(timeout=max(left, 0))
        except subprocess.TimeoutExpired:
            return None, "", ""
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)  # with what it has started
    return child.returncode, printed, errors


def measured(step: str, variant: str, small: bool, left: float) -> dict[str, Any]:
    """Carry out a step; a failure is an ``error`` among what was measured."""
    end = time.monotonic() + left
    with tempfile.TemporaryDirectory() as folder:
        # A first command only warms up, which tiny sizes do without.
        for command in commands(step, variant, small, folder)[-1 if small else 0 :]:
            begun = time.perf_counter()
            code, printed, errors = called(command, end - time.monotonic())
            if code is None:
                return {"error": f"not done after {left:.0f} s"}
            if code:
                lines = (errors or printed).strip().splitlines() or ["no message"]
                return {"error": f"exit code {code}: {'; '.join(lines[-2:])[:300]}"}
        return result(step, folder, printed) | {"wall_s": time.perf_counter() - begun}


def machine() -> dict[str, Any]:
    """Describe the machine: system, cores, and GPUs as the NVIDIA driver names them."""
    gpus = None
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
        gpus = subprocess.run(query, capture_output=True, text=True, timeout=20).stdout.splitlines()
    return {"system": platform.platform(), "cores": os.cpu_count(), "gpus": gpus}


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, 1 if a step of the variant failed."""
    parser = argparse.ArgumentParser(prog="experiments/gpu.sh", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT.json", help="where results go, after every step")
    parser.add_argument("--variant", default="cuda_ad_rgb", help="Mitsuba variant (%(default)s)")
    parser.add_argument("--minutes", type=float, default=8.0, help="at most (%(default)s)")
    parser.add_argument("--small", action="store_true", help="tiny sizes, to test this program")
    parser.add_argument("--steps", nargs="+", choices=STEPS, default=STEPS, metavar="STEP", help="these")
    given = parser.parse_args(argv)
    end = time.monotonic() + 60 * given.minutes
    steps: dict[str, dict[str, Any]] = {step: {} for step in given.steps}
    found = {"machine": machine(), "minutes": given.minutes, "small": given.small, "steps": steps}
    failed = False
    for variant in dict.fromkeys([given.variant, CPU]):
        for step in given.steps:
            if step != "doctor" and "error" in steps.get("doctor", {}).get(variant, {}):
                continue
            one = steps[step][variant] = measured(step, variant, given.small, end - time.monotonic())
            failed |= "error" in one and variant == given.variant
            write_atomically(given.out, json.dumps(found, indent=1).encode())
            print(f"{variant} {step}: {one.get('error') or format(one['wall_s'], '.1f') + ' s'}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
