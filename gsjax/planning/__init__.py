"""Choice of the settings that a scene needs: accuracy, SH degree and capacities.

`plan.plan` is the entry. `bounds` proves errors that hold for every camera, `accuracy`
chooses α cutoff and transmittance threshold by bounds or measurements, `sizes` chooses
capacities and tile sizes, and `types` holds the result with a reason for each setting.
"""
