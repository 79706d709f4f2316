"""Rigid objects pressed into a jaw: surface, indenter, penalty, equilibrium."""
