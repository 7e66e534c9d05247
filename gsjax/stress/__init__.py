"""Numerical stability as a scoreboard: cases with bounds, measured on this machine."""
