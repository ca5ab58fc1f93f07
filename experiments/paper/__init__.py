"""Tables 1 to 3 of the paper, under its settings and under ours."""
