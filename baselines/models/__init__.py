"""Models of the environment: predictors of the next observation and reward, one a file.

A predictor is a class with ``learn(transitions)`` and ``bits(transitions)``, see `baselines.models.model.Predictor`.
"""
