"""Contact sheets of what is done, and the chart of Figure 4; display values are gamma."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from envedit.core.atomic_files import write_atomically
from envedit.core.color import luminance, tonemap
from envedit.images import images
from experiments.harness import Done, done_of, figure, montage

GREY = 0.93
"""Display value of what is not done, or not known."""
FIRST = {"figure4": (("original",),), "figure5": (("original", "nothing"),)}
OWN = {"figure4": ("fitted",), "figure5": ("fitted", "noisy")}
"""Pictures of :func:`pictures`, one below the other for each map: in the first columns, and of a method."""
FIRST_OF_EDITS, OWN_OF_EDITS = (("initial_map", "initial"), ("true_map", "target")), ("map", "render")


def pictures(done: Done) -> dict[str, np.ndarray | None]:
    """Read the pictures of a run, linear radiance; maps are cut to the active rows.

    Returns
    -------
    dict
        Of an edit ``initial_map``, ``true_map`` (None where it is not known), ``map``, ``initial``,
        ``target``, ``render``; of a fit ``original``, ``fitted``, ``noisy``.
    """
    if "noisy" in done.metrics:
        return {name: done.picture(name) for name in ("original", "fitted", "noisy")}
    maps = zip(("initial_map", "map", "true_map"), done.maps, strict=True)
    renderings = {"initial": "initial", "target": "target", "render": "edited"}
    return {name: None if one is None else one[done.rows] for name, one in maps} | {
        name: done.picture(f"render_{file}") for name, file in renderings.items()
    }


def draw(name: str, made, out: Path, to: Path) -> list[Path]:
    """Draw a table or figure, a sheet for either settings and every roughness; returns the files.

    Figure 8 has its roughnesses side by side. A sheet of which nothing is done is left out.
    """
    done, parts, files = {one.case.name: one for one in done_of(made, out)}, {}, []
    for case, _ in made:
        part, roughness = case.about["settings"], case.about["roughness"]
        if name != "figure8" and roughness is not None:
            part += f"-roughness{roughness:g}"
        parts.setdefault(part, []).append(case)
    for part, cases in parts.items():
        if not any(case.name in done for case in cases):
            continue
        shown = {}
        for case in cases:
            place = tuple(case.about[key] for key in ("row", "map", "roughness"))
            shown[place] = pictures(done[case.name]) if case.name in done else {}
        columns = by_roughness(shown) if name == "figure8" else by_method(name, shown)
        files.append(to / f"{name}-{part}.png")
        write_atomically(files[-1], images.png(sheet(columns)))
        if name == "figure4":
            titles = {case.about["row"]: case.about["title"] for case in cases}
            files.append(to / f"{name}-{part}-histograms.png")
            histograms(shown, titles, files[-1])
    return files


def _first(shown, sky, roughness):
    """Return the pictures of any method that is done; none if none is."""
    return next((p for (_, m, r), p in shown.items() if (m, r) == (sky, roughness) and p), {})


def by_method(name: str, shown: dict) -> list[list]:
    """Return the columns of a sheet: before, target and every method, or the original and every network."""
    roughness = next(iter(shown))[2]
    rows, maps = (dict.fromkeys(key[i] for key in shown) for i in (0, 1))
    before = FIRST.get(name, FIRST_OF_EDITS)
    own = OWN.get(name, OWN_OF_EDITS)
    columns = [[_first(shown, sky, roughness).get(what) for sky in maps for what in some] for some in before]
    for row in rows:
        columns.append([shown.get((row, sky, roughness), {}).get(what) for sky in maps for what in own])
    return columns


def by_roughness(shown: dict) -> list[list]:
    """Return the columns of Figure 8: map before, true map and target, then map and rendering of each row."""
    rows, maps, roughnesses = (dict.fromkeys(key[i] for key in shown) for i in (0, 1, 2))
    columns = []
    for roughness in roughnesses:
        column = []
        for sky in maps:
            first = _first(shown, sky, roughness)
            column += [first.get(what) for what in ("initial_map", "true_map", "target")]
            for row in rows:
                column += [shown.get((row, sky, roughness), {}).get(what) for what in OWN_OF_EDITS]
        columns.append(column)
    return columns


def sheet(columns: list[list[np.ndarray | None]]) -> np.ndarray:
    """Lay out columns of pictures of linear radiance, as equally wide as whole factors make them.

    Returns
    -------
    ndarray (H, W, 3) of uint8
        Grey where there is no picture, of the size of those beside it.
    """
    lines = []
    for line in zip(*columns, strict=True):
        size = next((one.shape for one in line if one is not None), (1, 4, 3))
        lines.append([np.full(size, GREY) if one is None else tonemap(one, "gamma") for one in line])
    # A montage makes the pictures of its rows equally high: here it is made on its side.
    on_its_side = montage([[one.swapaxes(0, 1) for one in column] for column in zip(*lines, strict=True)])
    return np.ascontiguousarray(on_its_side.swapaxes(0, 1))


def histograms(shown: dict, titles: dict[str, str], file: Path) -> None:
    """Draw how many texels of each map and fit have what radiance, and its brightest texels: a row a map."""
    maps = dict.fromkeys(sky for (_, sky, _), found in shown.items() if found)
    with figure(file, len(maps), 2, (11, 4 * len(maps)), squeeze=False) as panels:
        for sky, (histogram, brightest) in zip(maps, panels, strict=True):
            drawn = {"original": _first(shown, sky, None)["original"]}
            drawn |= {titles[row]: p["fitted"] for (row, m, _), p in shown.items() if m == sky and p}
            for title, picture in drawn.items():
                light = np.sort(luminance(picture).ravel())[::-1] + 1e-3
                color = {"color": "black"} if title == "original" else {}
                counts, edges = np.histogram(np.log10(light), np.linspace(-3, 5, 65))
                histogram.stairs(np.maximum(counts, 0.5), edges, label=title, **color)
                brightest.loglog(np.arange(1, len(light) + 1), light, label=title, **color)
            histogram.set(yscale="log", ylim=(0.7, None), title=sky)
            histogram.set(xlabel="log10 of luminance + 0.001", ylabel="texels")
            brightest.set(xlabel="texels, the brightest first", ylabel="luminance + 0.001")
            brightest.legend(fontsize=7)
