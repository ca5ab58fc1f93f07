"""envedit: edit HDR environment maps by inverse rendering, natively in Dr.Jit.

``envedit.edit(config)`` carries out an edit, ``envedit.fit(image, ...)`` fits a SIREN,
``envedit.LightTransport.build(scene, ...)`` traces a light transport. They are imported on first use, so
that ``import envedit`` is quick and works without LLVM.
"""

from __future__ import annotations

__version__ = "0.1.0"
__all__ = ["Config", "LightTransport", "Result", "edit", "fit"]

_PUBLIC = {
    "Config": "envedit.config",
    "LightTransport": "envedit.transport.light_transport",
    "Result": "envedit.results",
    "edit": "envedit.api",
    "fit": "envedit.api",
}


def __getattr__(name: str) -> object:
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
