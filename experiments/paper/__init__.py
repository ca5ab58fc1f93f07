"""Tables 1 to 3 and Figures 4, 5, 8 and 9 of the paper, under its settings and under ours."""
