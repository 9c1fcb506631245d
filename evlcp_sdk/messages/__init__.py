"""Messages: what a transmitter says, as bytes, blocks and packets; the format is in `docs/messages.md`."""
