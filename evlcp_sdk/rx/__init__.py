"""From events to packets.

`receiver` joins the others, and `multi` says which of several links fits: `regions` follows what blinks (by
`rhythm`), `bars` sets it right by what frames show; `framing` finds packets in its events; of a frame,
`alignment` holds the bar still, `placement` finds its layout, `reading` says what it says, and `points`
what positions are computed from; `reflections` collects packets, and `inbox` reads their messages.
"""
