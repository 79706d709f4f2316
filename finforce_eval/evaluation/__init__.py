"""Estimators over recordings, offline: steps, results, scores, tables."""
