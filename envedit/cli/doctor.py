"""Find out whether this machine can run envedit, and say what is missing where it cannot.

Some LLVM releases load and compile small kernels, then abort the whole process at the first path-traced one
(mitsuba 3.9.1 with LLVM 15 and 16: "Cannot select ... fminimum"). Nothing in Python can catch that, so a
child process is the one to try: it selects the variant, traces a white environment over a grey plane, whose
radiance is the plane's albedo, and reports step by step on its standard output. What it managed to say before
it died, and its last words, are the diagnosis.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
import os
import platform
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from envedit.cli.console import make_parser
from envedit.core import interrupts, machine
from envedit.core.atomic_files import write_atomically
from envedit.core.errors import InputError, MachineError

ALBEDO = 0.5
_VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb", "metal_ad_rgb")
_GPU_REMEDIES = {
    "cuda_ad_rgb": ("NVIDIA GPU or driver", "install the NVIDIA driver"),
    "metal_ad_rgb": ("Apple GPU", "use a Mitsuba for macOS that has this variant"),
}
_TIMEOUT_SECONDS = 300  # a cold start on a loaded machine takes ten
_LLVM_REMEDY = (
    "install LLVM 19 (apt-get install libllvm19) or set DRJIT_LIBLLVM_PATH to the path of its libLLVM"
)
# Where Dr.Jit and the dynamic loader find libraries.
_FOLDERS = ("/usr/lib/*-linux-gnu", "/usr/lib64", "/usr/lib", "/usr/local/lib", "/opt/homebrew/opt/llvm/lib")


@dataclass(frozen=True)
class Diagnosis:
    """What a probe found."""

    ok: bool  # true if the probe rendered the right picture
    lines: tuple[str, ...] = ()  # if not ok: what is wrong and how to mend it, in one or two lines
    # What the probe came to know: ``mitsuba``, ``drjit``, ``llvm``, ``llvm_path``, ``radiance``,
    versions: dict = field(default_factory=dict)


# ---- The parent --------------------------------------------------------------------------------------------


def check(variant: str = "llvm_ad_rgb") -> Diagnosis:
    """Probe a variant in a child process and explain the outcome; never raises for a broken machine."""
    if variant not in _VARIANTS:
        cause = f"envedit does not run on variant {variant!r}"
        return Diagnosis(False, (cause, f"use {' or '.join(_VARIANTS)}"))
    for package in ("mitsuba", "drjit"):
        if machine.version(package) is None:
            return Diagnosis(False, (f"the package {package} is missing", f"run: pip install {package}"))

    # ---- The child, which finds this package even in a source checkout that is not installed
    root = str(Path(__file__).resolve().parents[2])
    program = (
        f"import sys; sys.path.append({root!r}); from envedit.cli import doctor; doctor._probe({variant!r})"
    )
    command = [sys.executable, "-P", "-c", program]  # -P: no module of the working folder
    code = None
    ended: subprocess.CompletedProcess | subprocess.TimeoutExpired
    try:
        ended = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=_TIMEOUT_SECONDS
        )
        code = ended.returncode
    except subprocess.TimeoutExpired as error:
        ended = error
    except OSError as error:
        return Diagnosis(False, (f"cannot start {sys.executable}: {error.strerror or error}",))
    output, error_output = ((text or b"").decode(errors="replace") for text in (ended.stdout, ended.stderr))

    # ---- What it found out before it ended
    versions: dict[str, Any] = {}
    for line in output.splitlines():
        with contextlib.suppress(ValueError):
            facts = json.loads(line)
            versions |= facts if isinstance(facts, dict) else {}

    # ---- Diagnosis
    if code == 0 and versions.get("done"):
        radiance = versions.get("radiance")
        if isinstance(radiance, float) and abs(radiance - ALBEDO) < 1e-3:
            return Diagnosis(True, (), versions)
        cause = f"the self test computed {radiance}, not {ALBEDO}, with {_backend(variant, versions)}"
        remedy = _LLVM_REMEDY if variant.startswith("llvm") else "update the driver or the system"
        return Diagnosis(False, (cause, remedy), versions)
    return Diagnosis(False, _explain(variant, code, error_output, versions), versions)


def ensure(variant: str = "llvm_ad_rgb") -> None:
    """Raise MachineError unless this machine can run a variant; cheap after the first success.

    A success is remembered in ``$XDG_CACHE_HOME/envedit`` (or ``~/.cache/envedit``) until Python, mitsuba,
    drjit or an LLVM library that is installed changes. Only success is remembered, with an LLVM whose changes
    would be seen. A cache that cannot be written costs a probe every time and nothing else.
    """
    memory = _memory(variant)
    if memory is not None and memory.exists():
        return
    diagnosis = check(variant)
    if not diagnosis.ok:
        raise MachineError("\n".join(diagnosis.lines))
    library = os.path.realpath(diagnosis.versions.get("llvm_path") or "")
    seen = library in map(os.path.realpath, _libraries()) or not variant.startswith("llvm")
    if memory is not None and seen:
        with contextlib.suppress(OSError, RuntimeError, InputError):
            memory.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(memory, b"")


def select(variant: str = "llvm_ad_rgb") -> None:
    """Select a variant of Mitsuba, as quiet as a command is, if :func:`ensure` finds that it works here."""
    ensure(variant)
    interrupts.import_mitsuba(variant)
    import mitsuba as mi

    mi.set_log_level(mi.LogLevel.Error)


def _explain(variant: str, code: int | None, error_output: str, versions: dict) -> tuple[str, str]:
    """Turn how the child ended and what it wrote to stderr into one line of cause and one of remedy."""
    backend = _backend(variant, versions)
    library = os.environ.get("DRJIT_LIBLLVM_PATH")
    errors = [line.strip() for line in error_output.splitlines() if line.strip()]

    # ---- Too slow, or a GPU
    if code is None:
        cause = f"the self test did not end in {_TIMEOUT_SECONDS} s with {backend}"
        return cause, "try again on an idle machine"
    if variant in _GPU_REMEDIES:
        device, remedy = _GPU_REMEDIES[variant]
        reason = _last(errors) if versions.get("selected") else f"no usable {device} was found"
        return f"{variant}: {reason}", f'use variant = "llvm_ad_rgb", or {remedy}'

    # ---- LLVM that cannot be loaded
    for line in errors:
        if "is too old" in line:
            version = line.partition("located LLVM version (")[2].partition(")")[0]
            named = f" ({library}, from DRJIT_LIBLLVM_PATH)" if library else ""
            return f"LLVM {version or 'here'}{named} is too old for this Dr.Jit", _LLVM_REMEDY
        if "Unable to load" in line and library:
            detail = line.rpartition(": ")[2].rstrip("!")
            return f"LLVM cannot be loaded from DRJIT_LIBLLVM_PATH={library}: {detail}", (
                "correct or unset DRJIT_LIBLLVM_PATH, or run: apt-get install libllvm19"
            )
    if "LLVM backend is inactive" in error_output or "LLVM shared library" in error_output:
        return "no LLVM library was found", _LLVM_REMEDY

    # ---- LLVM that cannot compile the kernels of a rendering
    if code < 0 or "LLVM ERROR" in error_output:
        name = f"exit code {code}"
        with contextlib.suppress(ValueError):
            name = signal.Signals(-code).name
        words = next((": " + line[:60] for line in errors if "LLVM ERROR" in line), "")
        return f"{backend} stops the process at the first rendering ({name}{words})", _LLVM_REMEDY
    return f"the self test failed with {backend}: {_last(errors)}", "to see more, run: envedit doctor"


def _backend(variant: str, versions: dict) -> str:
    if variant.startswith("llvm"):
        path = versions.get("llvm_path") or "path unknown"
        return f"LLVM {versions.get('llvm', 'of unknown version')} ({path})"
    return f"variant {variant}"


def _last(lines: list[str]) -> str:
    return lines[-1][:200] if lines else "it said nothing"


def _memory(variant: str) -> Path | None:
    """Return the file that remembers a success for this variant, these packages and these libraries."""
    from envedit.core.array_cache import cache_home  # with numpy

    libraries = [(name, os.stat(name).st_size, os.stat(name).st_mtime_ns) for name in _libraries()]
    versions = [machine.version("mitsuba"), machine.version("drjit")]
    named = [os.environ.get(name) for name in ("DRJIT_LIBLLVM_PATH", "LD_LIBRARY_PATH")]
    key = hashlib.sha256(repr([variant, sys.version, sys.executable, versions, libraries, named]).encode())
    home = cache_home()
    return None if home is None else home / f"doctor-{key.hexdigest()[:16]}"


def _libraries() -> list[str]:
    """List the files of LLVM libraries that Dr.Jit may load."""
    searched = os.environ.get("LD_LIBRARY_PATH", "").split(os.pathsep)
    folders = [*_FOLDERS, f"{sys.prefix}/lib", *filter(None, searched)]
    found = [name for folder in folders for name in glob.glob(f"{folder}/libLLVM*")]
    return sorted(filter(os.path.isfile, [*found, os.environ.get("DRJIT_LIBLLVM_PATH", "")]))


# ---- The child ---------------------------------------------------------------------------------------------


def _probe(variant: str) -> None:
    """Select the variant, render and multiply, saying what is known before each step that may be the last."""

    def say(**facts):
        print(json.dumps(facts), flush=True)

    # ---- Versions, the variant, and the LLVM library that it has loaded
    say(mitsuba=machine.version("mitsuba"), drjit=machine.version("drjit"))
    import drjit as dr
    import mitsuba as mi

    mi.set_variant(variant)
    dr.eval(mi.Float(1, 2) + 1)
    facts = {"selected": True, "llvm_path": machine.llvm_library()}
    if variant.startswith("llvm"):
        facts["llvm"] = machine.llvm_version()
    say(**facts)

    # ---- A rendering, and the speed of matrix products
    start = time.perf_counter()
    radiance = _self_test(mi)
    say(radiance=radiance, render_s=round(time.perf_counter() - start, 3))
    say(gflops=matmul_rate(256, 20))
    say(done=True)


def _self_test(mi: ModuleType) -> float:
    """Return the mean radiance of a plane of albedo 0.5 under a white map: 0.5, within the noise of 1e-3.

    A convex diffuse surface under radiance 1 reflects its albedo. The light is an ``envmap`` and is found by
    both of the integrator's strategies, so that the kernel is of the kind that stops the process with the
    wrong LLVM.
    """
    import numpy as np

    from envedit.core import installed_plugins

    to_world = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 32, "height": 32, "pixel_format": "rgb", "filter": {"type": "box"}}
    installed_plugins.come_first()
    scene = mi.load_dict(
        {
            "type": "scene",
            "light": {"type": "envmap", "bitmap": mi.Bitmap(np.ones((8, 16, 3), np.float32))},
            "plane": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(100),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": ALBEDO}},
            },
            "sensor": {"type": "perspective", "to_world": to_world, "film": film},
        }
    )
    integrator = mi.load_dict({"type": "path", "max_depth": 3})
    return float(np.array(mi.render(scene, integrator=integrator, spp=1024, seed=1)).mean())


def matmul_rate(size: int, repeats: int) -> float:
    """Return the rate of ``size`` x ``size`` matrix products in GFLOP/s, after one to compile."""
    import drjit as dr
    import mitsuba as mi

    a = dr.full(mi.TensorXf, 1 / size, (size, size))
    product = a @ a
    dr.eval(product)
    dr.sync_thread()
    start = time.perf_counter()
    for _ in range(repeats):
        product = a @ product
        dr.eval(product)
    dr.sync_thread()
    return round(2 * size**3 * repeats / (time.perf_counter() - start) / 1e9, 1)


# ---- The command line --------------------------------------------------------------------------------------


def main(arguments: list[str] | None = None) -> int:
    """Print the versions and the outcome of the self test; return the exit code, 0 or 4."""
    about = "Check whether this machine can run envedit: exit code 0, or 4 and what to do."
    parser = make_parser("doctor", about, ["envedit doctor --variant cuda_ad_rgb"])
    parser.add_argument(
        "--variant",
        default="llvm_ad_rgb",
        help=f"Mitsuba variant: {' or '.join(_VARIANTS)} (default: %(default)s)",
    )
    options = parser.parse_args(arguments)

    # ---- What is installed
    print(f"python    {platform.python_version()} ({sys.executable})")
    for package in ("mitsuba", "drjit", "OpenEXR", "numpy"):
        print(f"{package.lower():9} {machine.version(package) or 'missing'}")
    print(f"cores     {machine.cores()}")
    print(f"memory    {_memory_size()}")

    # ---- What the self test found
    diagnosis = check(options.variant)
    versions = diagnosis.versions
    if "llvm" in versions:
        print(f"llvm      {versions['llvm']} ({versions['llvm_path'] or 'path unknown'})")
    if "radiance" in versions:
        seconds = f"{versions['render_s']} s with compilation"
        print(f"render    {versions['radiance']:.5f}, expected {ALBEDO}; {seconds}")
    if "gflops" in versions:
        print(f"matmul    {versions['gflops']} GFLOP/s (256 x 256, float32)")

    # ---- Verdict
    missing = [name for name in ("OpenEXR", "numpy") if machine.version(name) is None]
    if diagnosis.ok and missing:
        diagnosis = Diagnosis(False, (f"missing packages; run: pip install {' '.join(missing)}",))
    print(f"{options.variant}: {'ready' if diagnosis.ok else 'cannot run envedit'}", flush=True)
    for line in diagnosis.lines:
        print(line, file=sys.stderr)
    return 0 if diagnosis.ok else MachineError.exit_code


def _memory_size() -> str:
    with contextlib.suppress(AttributeError, ValueError, OSError):
        return f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.1f} GB"
    return "unknown"
