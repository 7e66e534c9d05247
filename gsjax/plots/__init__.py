"""Charts and contact sheets as RGB arrays [H, W, 3] uint8.

Training curves, histograms of a scene, contact sheets of views, and the cells that a
notebook shows. `figures` is the only module that opens a Matplotlib canvas; Matplotlib
is imported when a chart or a caption is drawn, never by importing gsjax.
"""
