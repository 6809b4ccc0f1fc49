"""A sample of single-line mutants of our packages, and the tests that kill them.

``nice python -m tests.helpers.mutants`` puts each mutant into a copy of the checkout, runs its tests, and prints which
survive.
"""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[2]))  # has the helpers
