"""envedit: edit HDR environment maps by inverse rendering, natively in Dr.Jit.

``envedit.edit(config)`` carries out an edit, ``envedit.fit(image, ...)`` fits a SIREN,
``envedit.LightTransport.build(scene)`` traces a light transport; ``load_scene``, ``load_map`` and ``sunsky``
make what they take. Errors that a user can fix are subclasses of ``EnveditError``. All are imported on first
use, so that ``import envedit`` is quick and works without LLVM.
"""

from __future__ import annotations

import os

# Before numpy is imported. Dr.Jit has the cores. OpenBLAS, which numpy brings, waits for its own threads in
# loops: beside other work a factorisation of 700 unknowns took 1.1 s with two threads and 6 ms with one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__version__ = "0.3.0"
_PUBLIC = {
    "Config": "envedit.config",
    "ConfigError": "envedit.core.errors",
    "EnveditError": "envedit.core.errors",
    "InputError": "envedit.core.errors",
    "LightTransport": "envedit.transport.light_transport",
    "MachineError": "envedit.core.errors",
    "NumericalError": "envedit.core.errors",
    "Result": "envedit.results",
    "Scene": "envedit.scene.scene",
    "edit": "envedit.api",
    "fit": "envedit.api",
    "load_map": "envedit.api",
    "load_scene": "envedit.api",
    "sunsky": "envedit.api",
}
__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> object:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
