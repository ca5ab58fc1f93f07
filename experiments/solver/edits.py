r"""Times and errors of nine edits, to compare two versions of the solver.

    ENVEDIT_DATA=... OPENBLAS_NUM_THREADS=1 python -m experiments.solver.edits [--set table.key=value ...]

Every edit is run twice and the second time counts: kernels, T and the target's rendering are on disk then.
Prints a table, and the mean of its columns. Run it on either version, in one go, where nothing else runs.
"""

import argparse
import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np

EDITS = (  # map, scene, target (degrees or another map), whether the sky may turn
    ("sunflowers", "sphere", "60", False),
    ("sunflowers", "sphere", "autumn_field", True),
    ("rustig_koppie", "statue", "140", False),
    ("kloofendal_48d_partly_cloudy", "sphere", "140", False),
    ("wasteland_clouds", "statue", "60", False),
    ("evening_road_01", "sphere", "snow_field", True),
    ("mud_road", "statue", "sunflowers", True),
    ("syferfontein_18d_clear", "pair", "kloofendal_48d_partly_cloudy", True),
    ("kloppenheim_06", "sphere", "60", True),
)
COLUMNS = "solve, s", "total, s", "steps", "a step, ms", "rendering, dB", "map, dB"


def tables(files, name, scene, target, turn):
    """Return the configuration of an edit."""
    wanted = {"rotate_degrees": float(target)} if target.isdigit() else {"file": str(files[target])}
    return {
        "input": {"envmap": str(files[name])},
        "scene": {"file": scene},
        "target": wanted,
        "representation": {"turn": "auto" if turn else False},
    }


def main(arguments=None):
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--set", action="append", default=[], metavar="TABLE.KEY=VALUE")
    given = parser.parse_args(arguments)
    mi.set_variant("llvm_ad_rgb")
    from envedit import config, pipeline  # after the variant
    from experiments import puresky

    files, rows = puresky.of_script(), []
    print("| edit | " + " | ".join(COLUMNS) + " |\n" + "|---" * (1 + len(COLUMNS)) + "|")
    for edit in EDITS:
        with tempfile.TemporaryDirectory() as folder:
            settings = config.from_dict(tables(files, *edit), Path(folder), overrides=given.set)
            for _ in range(2):
                found = pipeline.run(settings).metrics
        timing = found["timing"]
        row = timing["solve_s"], timing["total_s"], found["iterations"], timing["per_iteration_ms"] or 0
        rows.append((*row, found["render"]["psnr"], found["envmap"]["psnr"]))
        print(_line(f"{edit[0]}, {edit[1]}, {edit[2]}", rows[-1]), flush=True)
    print(_line("mean", np.mean(rows, axis=0)))


def _line(name, row):
    digits = 2, 2, 1, 0, 2, 2
    return f"| {name} | " + " | ".join(f"{v:.{n}f}" for v, n in zip(row, digits, strict=True)) + " |"


if __name__ == "__main__":
    main()
