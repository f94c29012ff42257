"""The paper's schedule: gradient descent over frames in random order."""
