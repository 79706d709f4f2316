"""The subcommands of `finforce` that only a checkout has."""
