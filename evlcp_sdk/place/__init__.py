"""From image points to positions.

`positioner` joins the others: `whereabouts` (which bar stands where), `points` (a bar at a time between its
frames) and `pose`, which fits: `observations` (misses and slopes), `starts`, `fit`, `judgement`, `refusals`.
Beside it: `trajectory` (filter and smoother of fixes), `calibration` (of a camera, from known `poses`).
"""
