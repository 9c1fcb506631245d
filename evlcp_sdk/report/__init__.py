"""Pages and pictures of what was received, measured and compared."""
