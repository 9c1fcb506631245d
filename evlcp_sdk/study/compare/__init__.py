"""Variants of the receiver side by side: what each finds in the same recordings, how far off, how fast.

`variants` resolves what a user names, `recordings` receives recordings with all of them, `measured` is what
adds up, `table` finds who is best and writes it down; `campaigns` makes such tables of a campaign's results.
"""
