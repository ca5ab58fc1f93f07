"""The solver of layers: nine edits, and how a run grows."""
