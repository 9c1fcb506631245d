"""Campaigns: a grid of scenes and links, simulated, received and scored; resumable, on one machine or many.

`plan` reads a campaign file into points and tasks, `task` runs one, `store` keeps what is finished, `collect`
joins them over the executors of `jobs`. `summary` and `report` show what came out.
"""
