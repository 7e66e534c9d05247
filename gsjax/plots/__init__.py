"""Charts and contact sheets as RGB arrays [H, W, 3] uint8, drawn by Matplotlib.

Training curves, histograms of a scene, contact sheets of views, and the cells that a
notebook shows. `figures` has charts and opens the canvases.
"""
