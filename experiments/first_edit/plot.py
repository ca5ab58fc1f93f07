"""Draw what ``experiments.first_edit.run`` made: renderings over maps, a column a representation.

python -m experiments.first_edit.plot [--out runs/first_edit]
"""

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import mitsuba as mi

from .run import KINDS, MAPS, NAMES


def main():
    """Draw one sheet a map."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/first_edit"))
    parser.add_argument("--maps", nargs="+", default=MAPS)
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    from envedit.core import color
    from envedit.images import images

    def show(axis, path, title):
        axis.set_axis_off()
        if path.exists():
            axis.imshow(color.tonemap(images.read(path)[0]))
            axis.set_title(title, fontsize=7)

    for name in arguments.maps:
        figure, axes = plt.subplots(2, 1 + len(KINDS), figsize=(8, 4.2), height_ratios=(2, 1))
        show(axes[0, 0], arguments.out / f"{name}-{KINDS[0]}" / "render_target.exr", f"{name}: target")
        axes[1, 0].set_axis_off()
        for column, kind in enumerate(KINDS, 1):
            folder = arguments.out / f"{name}-{kind}"
            show(axes[0, column], folder / "render_edited.exr", NAMES[kind])
            show(axes[1, column], folder / "edited.exr", "")
        figure.tight_layout()
        figure.savefig(arguments.out / f"{name}.png", dpi=110)
        plt.close(figure)


if __name__ == "__main__":
    main()
