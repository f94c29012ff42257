"""Driving while it happens: landmarks of a camera's frames become the avatar's face, frame after frame.

`landmark_fit` fits one frame, `one_euro` smooths, and `follower` has the calibration and the way to rest.
"""
