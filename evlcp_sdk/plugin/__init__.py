"""How packages join: roles, hooks, and the registry of what is installed."""
