"""The frames that an avatar is trained on: sequences, splits, targets, and which sides of the head they show."""
