"""Twelve edits that lighting artists make, each painted in the page: ``artists.toml`` has their strokes."""

import tomllib
from pathlib import Path

from experiments import puresky
from experiments.harness import Experiment, calling
from experiments.paint import figure10
from experiments.summary import Summary


def cases(given):
    edits = tomllib.loads((Path(__file__).parent / "artists.toml").read_text())
    made = []
    for name, edit in edits.items():
        tables = {"input": {"envmap": puresky.file(edit["map"])}, "scene": {"file": edit["scene"]}}
        about = {"edit": name.replace("_", " "), "scene": edit["scene"], "map": edit["map"]}
        made.append(calling(name, figure10.edit, tables, about, strokes=edit["strokes"]))
    return made


EXPERIMENT = Experiment(
    cases,
    columns={
        "edit": "{edit}",
        "scene": "{scene}",
        "map": "{map}",
        "settled, s": "{settled_s:.0f}",
        "feasible known, s": "{solved_s:.0f}",
        **figure10.FIGURES,
    },
    summary=Summary(
        {},
        {
            "settled, s, median": "{settled_s.median:.0f}",
            "at most": "{settled_s.max:.0f}",
            "painted change reached": "{towards.mean:.0%}",
            "saved from shown, at most": "{differs.max:.4f}",
        },
    ),
    panels=figure10.panels,
    sheet=lambda case: "artists.jpg",
    alone=True,
)
