"""The paper's comparison: a network that is shown images and told forces, and nothing of mechanics."""
