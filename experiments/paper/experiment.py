"""Tables 1 to 3 and Figures 4, 5, 8 and 9 of the paper: ``python -m experiments paper run NAME``.

Tables share the runs they have in common. Sheets need matplotlib (envedit[report]).
"""

from envedit.core.errors import ConfigError
from experiments.harness import Experiment

from . import kinds, plan, tables


def options(parser):
    parser.add_argument("name", choices=kinds.KINDS, metavar="NAME", help=", ".join(kinds.KINDS))
    parser.add_argument("--settings", choices=("paper", "ours", "both"), default="both")
    parser.add_argument("--folder", metavar="DIR", help="of NAME_puresky_1k.hdr ($ENVEDIT_DATA/puresky)")
    parser.add_argument("--maps", nargs="+", metavar="MAP", help='some maps; "all" where one is the default')
    parser.add_argument("--rows", nargs="+", metavar="ROW", help="some rows; an unknown one lists them")
    parser.add_argument("--scene", default="", help="shipped scene or Mitsuba XML")
    parser.add_argument("--angle", type=float, default=60.0, help="turn of the true map to the left, degrees")
    parser.add_argument("--target", default="", metavar="MAP", help="figure8: the true map")
    parser.add_argument("--edit", default="", help="figure9: an edit of scenes/edits (move_shadow)")


def cases(given):
    question = plan.Question(given.scene, given.angle, given.target, given.edit, tuple(given.sets))
    settings = ("paper", "ours") if given.settings == "both" else (given.settings,)
    return plan.build(given.name, question, settings, given.folder, given.maps, given.rows, given.out)


def tabulate(made, out, given):
    return tables.text(given.name, out, [plan.cell(*one) for one in made])


def draw(made, out, to, given):
    try:
        from . import sheets
    except ImportError:
        raise ConfigError("no sheets: matplotlib is missing: run pip install '.[report]'") from None
    return sheets.draw(given.name, out, [plan.cell(*one) for one in made], to)


EXPERIMENT = Experiment(
    "paper",
    "Tables 1 to 3 and Figures 4, 5, 8 and 9 of the paper, under its settings and under ours.",
    cases,
    options=options,
    tabulate=tabulate,
    draw=draw,
    file=lambda given: given.name,
)
