"""From image points to positions.

`positioner` joins the others: `bar_registry` (where each bar stands), `points` (a bar between its frames) and
`pose`, which fits: `observations` (points, knowledge and errors), `fit` and `fit_assessment`. `navigator`
joins it with `gnss` and `trajectory` (filter and smoother of fixes). `calibration` of a camera uses known
poses, and `survey` of bars those of the camera's own track.
"""
