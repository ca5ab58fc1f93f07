"""Speed against accuracy: what each setting costs and what it is worth, beside the standard preset.

``settings.toml`` says what is run, ``cell.py`` carries it out, ``cost.py`` times each run, ``judge.py`` says
how good its map is, and ``experiment.py`` makes the tables.
"""
