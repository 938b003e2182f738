"""One file a subcommand of the bridge."""
