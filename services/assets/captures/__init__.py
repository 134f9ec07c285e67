"""Importers: captured grasps of public data sets become constraint sets.

A module for each format yields `Sequence`s, `extract` converts each into a `Demonstration` by the
paper's rules or drops it with a reason, and `build` collects them into objects and constraint sets.
"""

IMPORTERS = {
    "grab": "congrasp.services.assets.captures.grab",
    "oakink": "congrasp.services.assets.captures.oakink",
    "dexycb": "congrasp.services.assets.captures.dexycb",
    "myohand": "congrasp.services.assets.captures.myohand",
}
"""Module of each format, with `read(path, meshes, mano)`, which yields `Sequence`s and `Dropped`,
and `HOLDS`, a description of the data set's folder."""
