"""The commands `evlcp board`, `evlcp tx` and `evlcp loop`; thin, and light to import."""
