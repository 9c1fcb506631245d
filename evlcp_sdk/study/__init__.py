"""Comparison of what was received with what was sent.

`match` pairs `frames` with the truth's, `measure` counts them into the addable sums of `tally`; `score`,
`compare` and campaigns are views of that. `plan` reads a campaign into points and tasks, `task` runs one,
`store` keeps what is finished, `collect` joins them over the executors of `jobs`, `summary` adds up, and
`report` shows it.
"""
