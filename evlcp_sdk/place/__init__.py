"""From image points to positions.

`positioner` joins the others: `bar_registry` (which bar stands where), `points` (a bar at a time between its
frames) and `pose`, which fits: `observations` (what is seen and known), `fit` and `fit_assessment`.
`navigator` joins it with `gnss` and `trajectory` (filter and smoother of fixes); beside them: `calibration`
of a camera, from known poses, and `survey` of bars, by poses of its own track.
"""
