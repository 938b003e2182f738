"""One file a subcommand of training."""
