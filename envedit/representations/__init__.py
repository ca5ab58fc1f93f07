"""What the optimiser's parameters are: representations of the part of a map that is edited."""

from envedit.core.types import Params
from envedit.representations.base import EPSILON, Representation
from envedit.representations.choice import encoded, make
from envedit.representations.layers.layers import Layers
from envedit.representations.pixels import LogPixels, Pixels
from envedit.representations.siren.siren import Siren

__all__ = ["EPSILON", "Layers", "LogPixels", "Params", "Pixels", "Representation", "Siren", "encoded", "make"]
