"""The solver of layers: public scenes, course of the objective, cost of its parts."""
