"""User studies: people compare methods blind beside the truth, and their answers become percentages.

`making` writes the page and its key, from clips that `clips` chooses and `drawing` draws; `shuffling` is the order in
which a participant sees them; `files` are the key and the answers; `tally` counts. The last three need no torch.
"""
