"""User studies: people compare methods blind beside the truth, and their answers become percentages.

`making` writes the page and its key; `files` are the settings, the key, the answers and their tally.
"""
