"""What can be wrong with labels, data sets and checkpoints."""

from finforce.errors import FinforceError


class LabelFileError(FinforceError, ValueError):
    """A label file is none of DeepLabCut's, or does not fit the jaw."""


class DatasetError(FinforceError, ValueError):
    """Shards are missing, or hold something else than pictures with their points."""


class CheckpointError(FinforceError, ValueError):
    """A checkpoint is missing, or of another network."""


class RecipeError(FinforceError, ValueError):
    """A setting of the training has a value that it cannot have."""
