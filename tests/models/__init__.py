"""Models of the board's part, for tests and for `evlcp board emulate` from a checkout."""
