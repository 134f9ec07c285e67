"""The families of the procedural generator: what pieces a mug, a knife or a ring is made of.

A family is a function of a random generator that returns a `Draft`, in the table of its module. The generator
(`common.objects.procedural`) weighs, recentres and checks what it gets, and asks again where it does not like it.
"""

from congrasp.common.objects.families import basic, flat, scans, solids, tools, vessels
from congrasp.common.objects.families.draft import Builder, Draft

BASIC: dict[str, Builder] = basic.BUILDERS
"""Simple objects, those of a run that names no families."""
HOUSEHOLD: dict[str, Builder] = {**vessels.BUILDERS, **tools.BUILDERS, **flat.BUILDERS, **solids.BUILDERS}
"""Real things' shapes and sizes, most of them of convex mesh pieces."""
SCANS: dict[str, Builder] = scans.BUILDERS
"""Kinds of shape that scans have and the others lack."""
BUILDERS = {**BASIC, **HOUSEHOLD, **SCANS}

__all__ = ["BASIC", "BUILDERS", "HOUSEHOLD", "SCANS", "Draft"]
