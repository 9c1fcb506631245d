"""The link: one description of an air interface, a bar and a receiver."""
