"""Density control: strategies that add, move and remove Gaussians while training.

`types` defines the protocol (`Strategy`, `SlotEdit`, `apply_edit`); `adaptive`, `mcmc`
and `fixed` (no edits) implement it, one file per strategy. A training step passes each
observation to the strategy; when an edit is due, the strategy plans new contents of all
slots, and the same edit is applied to the parameters, the mask and the optimiser state.
"""
