"""``python -m ctgraph_rl.benchmark``."""

from ctgraph_rl.benchmark import main

main()
