"""A plan of trials: methods × initial scenes × repetitions, compared fairly. What to run (`plan`, `read`, `order`),
what came of it (`progress`, `telling`), how a real scene is built again (`scene_match`, `scene_gate`), and what a
session runs next (`course`).

`far trials` puts it together; the session runs its trials as any others.
"""
