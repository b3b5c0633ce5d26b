"""One file a subcommand; each exports run(request) -> RunResult and reads as its own data-flow diagram."""
