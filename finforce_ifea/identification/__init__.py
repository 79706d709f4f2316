"""Material constants of a finger from recordings with true forces."""
