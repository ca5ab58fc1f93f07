"""Speed against accuracy: what each setting costs and what it is worth, beside the standard preset.

``plan.py`` says what is run, ``runs.py`` carries it out, each run timed by ``measured.py``, ``judge.py`` says
how good its map is, ``analyse.py`` makes ratios, fronts and tables of that, and ``plot.py`` draws it.
"""
