"""The person in front of the camera: `survey` and `faces` find all faces, `people` says whom to follow and who is who.

`crop` frames the head; `matte` and `plate` say which pixels are the person's; `given` is what the user brings, and
`backend` chooses the library that runs the networks.
"""
