"""envedit: edit HDR environment maps by inverse rendering, natively in Dr.Jit."""

__version__ = "0.1.0"
