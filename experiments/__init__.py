import envedit.cli  # noqa: F401 -- as many threads of numpy as the command line has
