"""The `finforce` command, a file per subcommand."""
