"""Scene models that move: Gaussians as a function of time.

`trajectories` gives each Gaussian a motion of its own; `field` is a space-time grid
that moves all of them. `settings` holds their settings, `registry` the models by name.
"""
