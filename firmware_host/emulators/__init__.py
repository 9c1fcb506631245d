"""Boards without hardware: the native program, QEMU, a virtual board in this process; LED records."""
