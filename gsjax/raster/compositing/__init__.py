"""Compositing: splats and channels along sorted tile lists → images.

`compositor` is the one place that chooses a kernel. `fused` (with its reverse pass
`fused_vjp`), `chunked` and `parallel` are kernels behind one protocol,
`types.Compositor`; `alpha` and `blending` are the arithmetic that they share.
Everything here sees splats, channels and lists only, never Gaussians or cameras.
"""
