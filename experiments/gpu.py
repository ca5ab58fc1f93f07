"""What a GPU does beside the CPU of the same machine: ``experiments/gpu.sh OUT.json``.

Five steps, for the variant first and then for ``llvm_ad_rgb``, each in a process of its own that is ended
when the time is over:

- ``doctor``: the self test of ``envedit doctor``.
- ``quickstart``: ``envedit run quickstart``, with nothing from disk.
- ``engine``: T E, T' I and a step, a step of ``prb``, and a step of the standard preset's network
  (``experiments engine``: ``transport-sphere`` and ``siren-standard``).
- ``solver``: an edit of 128x128 pixels and a map of 256x128 by Gauss-Newton, the second of two runs.
- ``fit``: the paper's R-SIREN at its size, 256x128 texels; on the CPU a thirtieth of the epochs.

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
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from envedit.core.atomic_files import write_atomically

CPU = "llvm_ad_rgb"
SKY = {"envmap": "sunsky", "azimuth": 130, "elevation": 45}
CPU_EPOCHS = 1 / 30
"""Share of the paper's epochs that are measured on the CPU."""


# ---- the steps ---------------------------------------------------------------------------------------------


def doctor(variant: str, small: bool) -> dict[str, Any]:
    """Probe the variant."""
    from envedit.cli import doctor

    found = doctor.check(variant)
    if not found.ok:
        raise RuntimeError("; ".join(found.lines))
    return found.versions


def quickstart(variant: str, small: bool) -> dict[str, Any]:
    """Run the shipped configuration from the command line."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "envedit", "run", "quickstart", "--json", "--quiet", "--out", folder]
        options = [f"variant={variant}", "renderer.cache=false"]
        options += ["scene.width=32", "input.width=64"] if small else []
        for option in options:
            command += ["--set", option]
        done = subprocess.run(command, capture_output=True, text=True)
    result = json.loads(done.stdout)
    if not result["ok"]:
        raise RuntimeError(result["error"])
    return of_edit(result["metrics"])


def engine(variant: str, small: bool) -> dict[str, Any]:
    """Time the transport, ``prb`` and the network."""
    from envedit import config
    from experiments.engine import network, transport

    size, pixels = (64, 32) if small else (256, 256)
    lit = config.from_dict({"input": SKY | {"width": size}, "scene": {"file": "sphere", "width": pixels}})
    traced = transport.measure(lit, small)
    siren = config.from_dict({"representation": {"kind": "siren"}})
    trained = network.measure(siren, quick=small)["siren"][0]
    row, spent = traced["transport"][0], traced["transport-time"]
    seconds = {line["what"]: line["median_s"] for line in spent if not line["what"].startswith("floor")}
    return {
        "transport": {key: row[key] for key in ("first_s", "again_s", "load_s", "adjointness", "kernels")},
        "seconds": seconds,
        "network": {"step_s": trained["step"]["median_s"], "kernels": trained["kernels"]},
    }


def solver(variant: str, small: bool) -> dict[str, Any]:
    """Edit twice; the second time transport, renderings and kernels are there."""
    from envedit import config
    from experiments.solver.edits import second

    settings = {
        "variant": variant,
        "input": SKY | {"width": 64 if small else 256},
        "scene": {"file": "sphere", "width": 32 if small else 128},
        "target": {"rotate_degrees": 60},
        "representation": {"turn": False},
    }
    return of_edit(second(config.from_dict(settings), None))


def fit(variant: str, small: bool) -> dict[str, Any]:
    """Fit the paper's network to the sky, after a few epochs that compile its kernels."""
    import envedit
    from envedit import config

    settings = config.from_dict({"preset": "paper", "input": SKY | {"width": 64 if small else 256}})
    epochs = 6 if small else settings.fit.epochs
    if variant == CPU and not small:
        epochs = round(epochs * CPU_EPOCHS)
    sky = envedit.sunsky(settings.input.width, SKY["azimuth"], SKY["elevation"])
    envedit.fit(sky, settings.representation, replace(settings.fit, epochs=3))
    begun = time.perf_counter()
    found = envedit.fit(sky, settings.representation, replace(settings.fit, epochs=epochs))
    seconds = time.perf_counter() - begun
    quality = {"log_psnr": found.log_psnr, "peak_ratio": found.peak_ratio}
    return {"epochs": epochs, "seconds": seconds, "epoch_s": seconds / epochs, **quality}


def of_edit(metrics: dict) -> dict[str, Any]:
    """Keep of an edit's metrics how good it is, and how long it took."""
    quality = {name: metrics[name] and metrics[name]["psnr"] for name in ("initial", "render", "envmap")}
    return {"psnr": quality, "iterations": metrics["iterations"], "timing": metrics["timing"]}


STEPS: dict[str, Callable[[str, bool], dict[str, Any]]] = {
    "doctor": doctor, "quickstart": quickstart, "engine": engine, "solver": solver, "fit": fit,
}  # fmt: skip


# ---- all of them -------------------------------------------------------------------------------------------


def measured(step: str, variant: str, small: bool, left: float) -> dict[str, Any]:
    """Carry out a step in a process of its own; a failure is an ``error`` among what was measured."""
    if left <= 0:
        return {"error": "no time left"}
    command = [sys.executable, "-m", "experiments.gpu", "-", "--step", step, "--variant", variant]
    command += ["--small"] if small else []
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, start_new_session=True) as child:
        try:
            out, errors = child.communicate(timeout=left)
        except subprocess.TimeoutExpired:
            return {"error": f"not done after {left:.0f} s"}
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)  # with what it has started
    try:
        return json.loads(out.splitlines()[-1])
    except (IndexError, ValueError):
        said = errors.strip().splitlines() or ["it said nothing"]
        return {"error": f"exit code {child.returncode}: {said[-1][:300]}"}


def machine() -> dict[str, Any]:
    """Describe the machine: system, cores, and GPUs as the NVIDIA driver names them."""
    gpus = None
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        asked = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total", "--format=csv,noheader"]
        gpus = subprocess.run(asked, capture_output=True, text=True, timeout=20).stdout.splitlines()
    return {"system": platform.platform(), "cores": os.cpu_count(), "gpus": gpus}


def one(step: str, variant: str, small: bool) -> dict[str, Any]:
    """Carry out a step in this process."""
    begun = time.perf_counter()
    try:
        if step not in ("doctor", "quickstart"):  # which start processes of their own
            import mitsuba as mi

            mi.set_variant(variant)
        found = STEPS[step](variant, small)
    except Exception as error:  # whatever a device refuses is a result
        return {"error": f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"}
    return found | {"wall_s": time.perf_counter() - begun}


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0, 1 if a step of the variant failed."""
    parser = argparse.ArgumentParser(prog="experiments/gpu.sh", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT.json", help="where results go, after every step")
    parser.add_argument("--variant", default="cuda_ad_rgb", help="Mitsuba variant (%(default)s)")
    parser.add_argument("--minutes", type=float, default=8.0, help="at most (%(default)s)")
    parser.add_argument("--small", action="store_true", help="tiny sizes, to test this program")
    parser.add_argument("--step", choices=STEPS, help=argparse.SUPPRESS)
    given = parser.parse_args(argv)
    if given.step:
        print(json.dumps(one(given.step, given.variant, given.small)))
        return 0
    end = time.monotonic() + 60 * given.minutes
    steps: dict[str, dict[str, Any]] = {step: {} for step in STEPS}
    found = {"machine": machine(), "minutes": given.minutes, "small": given.small, "steps": steps}
    failed = 0
    for variant in dict.fromkeys([given.variant, CPU]):
        for step in STEPS:
            if step != "doctor" and "error" in steps["doctor"][variant]:
                continue
            result = steps[step][variant] = measured(step, variant, given.small, end - time.monotonic())
            failed += "error" in result and variant == given.variant
            write_atomically(given.out, json.dumps(found, indent=1).encode())
            said = result.get("error") or f"{result['wall_s']:.1f} s"
            print(f"{variant} {step}: {said}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
