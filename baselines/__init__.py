"""Baseline agents, one per file."""
