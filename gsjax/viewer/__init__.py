"""Scenes in the browser with viser, and pictures in notebooks.

`opening` loads a file or run into `ViewerContent` (`session`), which `server` shows to
every browser, also while it is trained, and `page` writes as one HTML file. `splats`
converts Gaussians to what viser draws, `exact` renders with gsjax for the camera of a
browser, `cameras` holds frusta and viewpoints, `viser_server` starts and stops viser.
`notebook` draws renders, scenes and movies in Jupyter, and saves pictures.
"""
