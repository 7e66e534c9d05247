"""Scenes in the browser, by viser: interactive, while training, or as one page."""
