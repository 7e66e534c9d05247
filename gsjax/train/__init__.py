"""Training: from a dataset and its photographs to Gaussians, in memory.

`config` holds the settings and `frames` the photographs. `step` differentiates the loss
terms of `losses` through the scene model of `models`, applies the optimiser of
`optimiser` and the strategy of `gsjax.densify`. `step_compiler` compiles these stages
for the sizes that `capacity_policy` chooses, and `loop` runs them. Files are handled by
`gsjax.runs`.
"""
