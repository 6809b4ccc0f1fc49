"""Submissions of finished runs to named tracks, their verification by others, and the board that shows them.

It imports runs, reports and everything below them; nothing but commands imports it.
"""
