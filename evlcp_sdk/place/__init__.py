"""From image points to positions.

`positioner` joins the others: `bar_registry` (which bar stands where), `points` (a bar at a time between its
frames) and `pose`, which fits: `observations` (misses and slopes), `starts`, `fit`, `fit_assessment`,
`rejections`.
`navigator` joins it with `trajectory` (filter and smoother of fixes); beside them: `calibration` (of a
camera, from known `poses`), `survey` (of bars) and `bearing` (a bar in the camera's axes, by one frame).
"""
