"""Lines to boards: serial ports, sockets, and the part's boot loader."""
