"""Functions on arrays of numbers, without scenes: `numerics`, `rotations`, `sh`."""
