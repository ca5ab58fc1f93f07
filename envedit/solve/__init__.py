"""From a target to the parameters of an edit: search, solver, loop."""
