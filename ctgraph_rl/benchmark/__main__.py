"""``python -m ctgraph_rl.benchmark``."""

import sys

from ctgraph_rl.packages import speed_suite

try:
    main = speed_suite("environments").main
except ImportError as error:
    sys.exit(str(error))
main()
