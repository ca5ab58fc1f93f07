r"""How the parts of a run grow with the picture and with the map.

    ENVEDIT_DATA=... python -m experiments.solver.growth [--scene sphere] [--sizes 128x256 256x256 ...] \
        [--set table.key=value ...]

Every size, pixels by columns of the map, is run twice and the second time counts: kernels, T and the target's
rendering are on disk then. Prints a table of seconds. Nothing else may run on the machine.
"""

import argparse
import tempfile
from pathlib import Path

import mitsuba as mi

SIZES = ("128x256", "256x256", "512x256", "128x512", "512x512")
PARTS = ("target", "fit", "transport", "start", "edit", "judge", "total")


def main(arguments=None):
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="sphere")
    parser.add_argument("--map", default="sunflowers")
    parser.add_argument("--sizes", nargs="+", default=SIZES)
    parser.add_argument("--set", action="append", default=[], metavar="TABLE.KEY=VALUE")
    given = parser.parse_args(arguments)
    mi.set_variant("llvm_ad_rgb")
    from envedit import config, pipeline  # after the variant
    from experiments import puresky

    file = puresky.of_script([given.map])[given.map]
    names = [f"{part}_s" for part in PARTS]
    print("| picture, map | steps | a step, ms | " + " | ".join(PARTS) + " |\n|" + "---|" * (3 + len(PARTS)))
    for size in given.sizes:
        pixels, columns = (int(n) for n in size.split("x"))
        text = (
            f'[input]\nenvmap = "{file}"\nwidth = {columns}\n[scene]\nfile = "{given.scene}"\n'
            f"width = {pixels}\n[target]\nrotate_degrees = 60\n[representation]\nturn = false\n"
        )
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "growth.toml"
            path.write_text(text)
            for _ in range(2):
                found = pipeline.run(config.load(path, overrides=given.set)).metrics
        timing = found["timing"]
        seconds = " | ".join(f"{timing[name]:.2f}" for name in names)
        row = f"| {pixels}², {columns}x{columns // 2} | {found['iterations']} "
        print(f"{row}| {timing['per_iteration_ms'] or 0:.0f} | {seconds} |", flush=True)


if __name__ == "__main__":
    main()
