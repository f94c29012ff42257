"""The person in front of the camera: `survey` and `faces` find all faces, `people` and `same_person` whom to follow.

`crop` frames the head; `matte`, `plate`, `screen` and `matte_owner` say which pixels are the person's; `given` is
what the user brings.
"""
