"""Looks: maps in the light of another edit."""
