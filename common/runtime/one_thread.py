"""Limits NumPy's linear algebra to one thread in processes that import this first.

Workers that share a machine would otherwise each start as many threads as the machine has cores, which then wait for
one another. For products as small as those of heading sets this costs several times the work itself.
"""

import os

for _name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
