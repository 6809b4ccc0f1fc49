"""What methods share: masks and their selection, importance of weights, heads, and labels that a detector gives.

A module belongs here if two methods need it. None is a method that a configuration names.
"""
