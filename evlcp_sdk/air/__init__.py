"""What both ends of the link share: codes, frames, blocks, beacons, signatures."""
