"""Seeded families of hard input, and the rule that every answer is held to."""
