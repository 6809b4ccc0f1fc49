"""Lifelong-learning methods, which any agent that derives from `baselines.learner.Learner` can wear."""
