"""A message kind and an output format for the EVLCP SDK, each in one file."""
