"""Faces, landmarks and mattes by MediaPipe's published networks, run by ai-edge-litert in place of mediapipe.

It serves where mediapipe 0.10.21 has no package: Python 3.13 and later, and Linux on ARM. What stands before and after
the networks is written here, from the networks' published descriptions. `networks` loads them, `boxes` finds faces,
`mesh` finds landmarks, and `person` finds the person. `mien.capture.person.backend` chooses between both.
"""
