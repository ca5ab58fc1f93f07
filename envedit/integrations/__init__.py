"""Extensions of other programs: they start envedit, import nothing of it, and are not installed with it."""
