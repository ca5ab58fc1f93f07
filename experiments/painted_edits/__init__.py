"""The six painted edits of Sec. 6.4 and Figures 9 and 10 of the paper, measured."""
