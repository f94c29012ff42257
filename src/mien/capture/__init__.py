"""Capture: turn a video of a head, or the videos of several calibrated cameras, into frames, mattes and landmarks.

`from_video` runs five steps:

1. `media/source.py` opens a video file or a folder of pictures and selects its frames.
2. `person/survey.py` is the first pass: it finds all faces in every frame, and checks that they are upright.
3. `parts` splits the video at cuts, and chooses for each part the person to follow and one crop (`person/`).
4. `process` is the second pass: it crops each frame, finds the person's landmarks, makes the matte (`person/`),
   measures blur and light (`quality`), and writes the pictures and their decoded cache (`frame_files`).
5. `process` then writes the results of all frames beside the pictures and moves the folder to its place (`store`).

`from_cameras` runs the same steps for the videos of a rig (`cameras/`). `job` has what both share: the request, its
key, and the folders of its work. `capture` has the class `Capture`, and `store` writes and reads it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
