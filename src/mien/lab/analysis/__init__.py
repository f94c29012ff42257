"""Analyses: what a method's paper measures on a trained run, beside the paper's own figures.

`spec` says what an analysis is, `registry` lists them by method, `result` holds what a part gives, and `running` runs
the parts and writes analysis.json, plots and one page. Only the package of a method knows that method.
"""
