"""Linear algebra in one thread: matrices here are small, and threads that wait for one another cost more than that."""

import os
from typing import Final

_NAMES: Final = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def one_thread() -> None:
    """Keep NumPy's and SciPy's linear algebra to one thread; call it before NumPy is imported.

    What the environment says already stands. A diagnosis takes half the processor time, and three quarters of the time,
    that it takes with a thread for each core. JAX has threads of its own and is not touched.
    """
    for name in _NAMES:
        os.environ.setdefault(name, "1")
