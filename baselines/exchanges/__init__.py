"""What learners of a collective tell each other: one exchange per file, on the base classes in ``exchange.py``.

Imports what `baselines.methods` imports, and the methods.
"""
