"""The fit to pixels: the texture and light of a head, and the steps that make all pictures agree with them."""
