"""Arrays of numbers: `np` is NumPy where it is installed, and otherwise a subset of it in plain Python.

The subset has the same names and gives the same results, bit for bit. What it lacks raises an error. Modules that must
run without NumPy import `np` and `NDArray` from here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
else:
    try:
        import numpy as np
        from numpy.typing import NDArray
    except ImportError:
        from powderdsl.arrays import plain as np

        NDArray = np.ndarray

__all__ = ["NDArray", "np"]
