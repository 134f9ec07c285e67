"""Gives NumPy's linear algebra one thread in processes that import this first.

Workers that share a machine would otherwise start as many threads each as the machine has cores, which then wait for
one another: on products as small as those of heading sets that costs several times the work itself.
"""

import os

for _name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
