"""Print how fast this machine is in a configuration's scene, as ``--budget`` measures it.

``python -m experiments.levels.calibrate FILE.toml``: one line of JSON, :class:`.budget.Calibration`.
"""

import dataclasses
import json
import sys
from pathlib import Path

import mitsuba as mi

from envedit import config


def main(argv: list[str]) -> int:
    """Calibrate for the configuration that is named; returns the exit code."""
    settings = config.load(argv[1])
    mi.set_variant(settings.variant)
    from envedit.cli import budget

    found, _ = budget.calibrate(settings, Path(argv[1]).parent)
    print(json.dumps(dataclasses.asdict(found)))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv))
