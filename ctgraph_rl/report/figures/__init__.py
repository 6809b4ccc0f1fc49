"""The figures of a report: curves, heat maps and trees, each with its caption and the table behind it.

It imports the rules of intervals, styles and runs; `ctgraph_rl.report.page` puts the figures on a page.
"""
