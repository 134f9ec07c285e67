"""Importers: captured grasps of public data sets become constraint sets.

A module for each format (`grab`, `oakink`, `dexycb`, `myohand`) yields `Sequence`s, `extract` turns each into a
`Demonstration` by the paper's rules or says why not, and `build` gathers them into objects and constraint sets.
"""
