"""Speed against accuracy: what each setting costs and what it is worth, beside the standard preset.

``plan.py`` says what is run, ``cell.py`` carries it out, each run timed by ``cost.py``, ``judge.py`` says how
good its map is, and ``experiment.py`` makes the tables.
"""
