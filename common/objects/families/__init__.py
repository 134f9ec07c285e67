"""Families of the procedural generator: the pieces of a mug, a knife or a ring.

A family is a function of a random generator that returns a `Draft`, listed in the table of its
module. The generator (`common.objects.procedural`) computes mass and inertia, recentres and checks
each draft, and draws again if it is rejected.
"""

from congrasp.common.objects.families import basic, scans, solids, tools, vessels
from congrasp.common.objects.families.draft import Builder, Draft

BASIC: dict[str, Builder] = basic.BUILDERS
"""Simple objects; the default of a run that names no families."""
HOUSEHOLD: dict[str, Builder] = {**vessels.BUILDERS, **tools.BUILDERS, **solids.BUILDERS}
"""Objects with realistic shapes and sizes, most of them of convex mesh pieces."""
SCANS: dict[str, Builder] = scans.BUILDERS
"""Shapes found in scans that other families lack."""
BUILDERS = {**BASIC, **HOUSEHOLD, **SCANS}

__all__ = ["BASIC", "BUILDERS", "HOUSEHOLD", "SCANS", "Draft"]
