"""Numerical stability as a scoreboard: cases with bounds, measured on this machine.

`run.CASES` lists the cases, which the other modules define by topic; `scenes` has the
scenes and compiled functions that they share. `gsjax stress` runs them.
"""
