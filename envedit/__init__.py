"""envedit: edit HDR environment maps by inverse rendering, natively in Dr.Jit.

``envedit.edit(config)`` carries out an edit, ``envedit.fit(image, ...)`` fits a SIREN,
``envedit.LightTransport.build(scene, ...)`` traces a light transport. They are imported on first use, so
that ``import envedit`` is quick and works without LLVM.
"""

import importlib

__version__ = "0.1.0"


def __getattr__(name):
    if name in ("edit", "fit"):
        return importlib.import_module(f".{name}", __name__)
    if name == "LightTransport":
        return importlib.import_module(".transport", __name__).LightTransport
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
