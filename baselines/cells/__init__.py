"""Cells, one file each: what stands behind the encoder of an agent with memory.

`baselines.cells.cell` says what a cell is. A file of ``conf/cell`` names each with its settings.
"""
