"""Modules that can be called: ``envedit.fit(image, ...)`` beside ``python -m envedit.fit``."""

import sys
from types import ModuleType


class _Callable(ModuleType):
    def __call__(self, *arguments, **named):
        return self._call(*arguments, **named)


def make_callable(name: str, function) -> None:
    """Let the imported module ``name`` be called like its main function."""
    module = sys.modules[name]
    module.__class__, module._call = _Callable, function
