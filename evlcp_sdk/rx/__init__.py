"""From events to packets.

`receiver` joins the other modules, and `multi` decides which of several links fits. `regions` tracks what
blinks, by `rhythm`, and frames correct it by what they show; `framing` finds packets in its events. Of a
frame, `alignment` holds the bar still, `placement` finds its layout, `reading` decodes its symbols, and
`points` gives what positions are computed from. `reflections` collects packets, and `inbox` reads their
messages.
"""
