"""Checks, when it is imported, that the packages of all benchmarks can be imported; one line names the missing ones.

Detection, restoration and tracking of tensors need these packages only. Sections that need more say so when they run.
"""

import sys
from importlib.util import find_spec
from pathlib import Path

PACKAGES = {  # module: name in the package index
    "torch": "torch",
    "numpy": "numpy",
    "scipy": "scipy",
    "kornia": "kornia",
    "kornia_rs": "kornia-rs",
    "lazy_loader": "lazy-loader",
    "psutil": "psutil",
}

if find_spec("rsvib_torch") is None:  # the package is not installed: use the working tree
    sys.path.append(str(Path(__file__).parents[2]))
missing = [package for module, package in PACKAGES.items() if find_spec(module) is None]
if missing:
    print(f"benchmark: packages are missing: pip install {' '.join(missing)}", file=sys.stderr)
    sys.exit(2)
