"""From events to packets.

`receiver` joins the others, `listener` those of one link, and `contest` says which of several links fits:
`timeline` (time steps), `detection` (regions), `steps` (the link's algorithms), `transmitters` and `grid`
(whose frame is due when), `look` and `plausibility` (a frame with the bar held still), `points` (what
positions are computed from), `packets` and `inbox` (packets and messages).
"""
