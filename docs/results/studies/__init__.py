"""The studies of the pages of results: raw results from runs, and tables, texts and figures from raw results.

Each module or folder is one study; `raw` reads tables, and `make.py` beside this folder is the command.
"""
