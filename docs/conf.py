"""Sphinx: ``python -m sphinx -W -q -c docs . build/site`` from the root; ``tests/integration/test_docs.py``.

The source folder is the root of the repository, so that the pages beside the experiments, the change log and
the licence are pages of the site where they lie, and every link works on the site as in the repository.
"""

import envedit

project = "envedit"
author = "the envedit authors"
copyright = f"2026, {author}"
version = release = envedit.__version__

root_doc = "docs/index"
include_patterns = ["docs/**", "experiments/*/*.md", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md"]
exclude_patterns = ["docs/_redirect", ".*", "envedit", "tests", "scenes", "runs", "build", "dist"]

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["deflist"]
myst_heading_anchors = 4
nb_execution_mode = "off"  # the tests execute the notebooks; -D nb_execution_mode=force shows what they print

autodoc_typehints = "none"  # numpydoc's sections say them
autodoc_member_order = "bysource"
napoleon_google_docstring = False
napoleon_use_rtype = False

html_theme = "furo"
html_title = f"envedit {version}"
html_extra_path = ["_redirect"]  # index.html at the top, which leads to docs/index.html
html_copy_source = False
html_show_sphinx = False
