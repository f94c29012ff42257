"""Trained features of pictures: ST-LPIPS, which scores pictures, and the features of another trunk, for training.

What is scored is never trained: the distance of the scores uses an AlexNet, the loss of training a VGG.
"""
