"""Campaigns: a grid of scenes and links, simulated, received and scored; resumable, on one machine or many.

`plan` reads a campaign file into points and tasks, `task` runs one, `executor` and `cluster` decide where,
`store` keeps what is finished, `collect` joins them. `summary` and `report` show what came out.
"""
