"""Forces into recordings that exist."""
