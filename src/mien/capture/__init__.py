"""Capture: turn a video of a head, or the videos of several calibrated cameras, into frames, mattes and landmarks.

`from_video` runs five steps. Each has its file, and the helpers that it needs:

1. `source` opens a video file or a folder of pictures and selects its frames. Helpers: `video` reads and writes frames,
   `video_file` opens video files safely, `display` and `tone` convert their pictures to sRGB, `picture` reads picture
   files safely, `alpha` takes the alpha of a source as its mattes, and `given` reads what the user gives besides (clean
   plate, mattes, landmarks).
2. `survey` is the first pass: it finds all faces in every frame (`faces`, MediaPipe) and checks that they are upright.
3. `parts` splits the video at cuts, and chooses for each part the person to follow (`people`) and one crop (`crop`).
4. `process` is the second pass: it crops each frame, finds the person's landmarks, makes the matte (`matte`, `plate`),
   measures blur and light (`quality`), and writes the pictures (`frame_files`).
5. `outcome` writes the results of all frames beside the pictures and moves the folder to its place. `pace` measures the
   frame rate and finds pauses.

`from_cameras` runs the same steps for the videos of a rig: `calibration` reads its cameras, and `head_path` finds the
head in their world and chooses the crops.

`capture` has the class `Capture`, `store` writes and reads it, and `cache` has its decoded frames. `settings` has the
settings, and `quiet_mediapipe` loads MediaPipe without its messages.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
