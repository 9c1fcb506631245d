"""Why a recording is read, or is not: what blinks in it, and which stage of the receiver stops it."""
