"""Speed against accuracy: what each setting costs and what it is worth, beside the standard preset.

``plan.py`` says what is run, ``measured.py`` carries out one run and measures it, ``judge.py`` says how good
its map is, ``experiment.py`` drives all that, ``analyse.py`` makes ratios, fronts and tables of the results,
and ``plot.py`` draws them.
"""
