"""SIREN: the network, its fit under adversarial weight perturbation, its last layer solved for."""
