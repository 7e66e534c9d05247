"""Training runs with files: everything that a run reads from or writes to its folder.

`run` starts and resumes; `folder` names the files and holds the settings; a `session`
logs, checkpoints and evaluates while `gsjax.train.loop.fit` trains. Data goes from
`folder.load_split` through `initialisation` and `fit` to `checkpoint`, `history` and
`evaluation`. `scene_source`, `views`, `trajectories` and `export` use a finished scene.
"""
