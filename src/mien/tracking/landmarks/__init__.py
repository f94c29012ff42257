"""The fit to landmarks: the response of the detector, the cost of landmarks, and the stages of the fit."""
