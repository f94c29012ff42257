"""Analyses: what a method's paper measures on a trained run, beside the paper's own figures.

`registry` lists the analyses and their parts. A part is a function from a run and options (`running.Context`) to
figures (`result`). `running` runs parts and writes analysis.json and one page. `measuring` has what parts measure and
draw. Only the file of a method knows that method. `study` is apart: people compare runs.
"""
