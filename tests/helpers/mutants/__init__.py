"""A sample of single-line mutants of our packages, and the tests that kill them.

``python -m tests.helpers.mutants`` puts each mutant into a copy of the checkout, runs its tests, and prints which live.
"""
