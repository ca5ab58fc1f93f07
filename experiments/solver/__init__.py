"""The solver of layers: course of the objective, cost of its parts."""
