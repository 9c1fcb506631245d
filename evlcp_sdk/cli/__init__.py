"""The `evlcp` command line: thin commands over the SDK; heavy imports happen inside a command.

Annotations of commands are postponed: what Typer reads in them takes longer to make than a module to load,
and is made for the command that is called.
"""
