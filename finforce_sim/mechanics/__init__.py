"""Jaws of drawn material in equilibrium with an object."""
