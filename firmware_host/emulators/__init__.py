"""Boards without hardware: the native program, a virtual board in this process, models; LED records."""
