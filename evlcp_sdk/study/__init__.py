"""What was received beside what was sent.

`frames` are matched with the truth by `match`, counted by `measure` into what adds up in `tally`; `score`,
`compare` and campaigns are views of that. `plan` reads a campaign into points and tasks, `task` runs one,
`store` keeps what is finished, `collect` joins them over the executors of `jobs`, `summary` adds up, and
`report` shows it.
"""
