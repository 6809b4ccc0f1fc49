"""Builders, oracles and made-up runs that several test files use."""
