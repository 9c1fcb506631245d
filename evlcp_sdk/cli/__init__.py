"""The `evlcp` command line: thin commands over the SDK; heavy imports happen inside a command."""
