"""What a run leaves behind: files and figures."""
