"""Importers: captured grasps of public data sets become constraint sets.

A module for each format yields `Sequence`s, `extract` turns each into a `Demonstration` by the paper's rules or says
why not, and `build` gathers them into objects and constraint sets.
"""

IMPORTERS = {
    "grab": "congrasp.services.assets.captures.grab",
    "oakink": "congrasp.services.assets.captures.oakink",
    "dexycb": "congrasp.services.assets.captures.dexycb",
    "myohand": "congrasp.services.assets.captures.myohand",
}
"""Module of each format. It has `read(path, meshes, mano)`, which yields `Sequence`s and what was `Dropped`, and
`HOLDS`, which says what a folder of the data set holds."""
