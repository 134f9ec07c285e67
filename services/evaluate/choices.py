"""Choices of an evaluation: its tables, and its sets of procedural objects. The command line offers
them before it loads the modules that evaluate.
"""

from typing import Literal

Table = Literal[
    "single",
    "composed",
    "cross",
    "hands",
    "ablation",
    "objects",
    "noise",
    "sensing",
    "payload",
    "peers",
    "all",
]
Exam = Literal["figures", "development"]
"""Sets of procedural objects: one for published figures, one for development."""
