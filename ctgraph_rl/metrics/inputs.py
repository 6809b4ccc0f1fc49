"""The inputs of metrics that a run gives, by the names of arguments."""

INPUTS = {
    "performance": "the performance matrix, float64 [blocks + 1, tasks]",
    "trained": "for each block, the tasks that it trained, counted from 0",
    "curves": "`Curves`, the evaluations in time order",
    "mastery_curves": "as ``curves``, with shares of episodes at the goal for tasks whose rewards have noise",
    "mastery_thresholds": "for each task, the value of these from which on it is mastered, float64 [tasks]",
    "evaluation_noise": "for each task, the standard deviation of the noise in an evaluation's return, float64 [tasks]",
    "best": "each task's optimal mean return, float64 [tasks]; NaN where it is not known",
    "zero": "each task's return of a failure, float64 [tasks]",
    "open_loop_ceilings": "each task's best mean return without observations, float64 [tasks]",
    "memoryless_ceilings": "each task's best mean return without memory, float64 [tasks]",
    "random_entropies": "each task's H(state | observation) in bits under the random policy, float64 [tasks]",
    "navigation_entropies": "the same under the navigating policy",
    "optimal_entropies": "the same under the optimal policy",
    "end_rates": "share of each task's last evaluation episodes that reached an end state, float64 [tasks]",
    "success_rates": "share of them that reached the goal, float64 [tasks]",
    "episodes": "finished episodes of each training interval, float64 [intervals]",
    "returns": "their mean return, float64 [intervals]; NaN without episodes",
    "labelling": "the labels that the learner gave to tasks itself, `Labelling`",
    "interval_best": "optimal mean return of each interval's task, float64 [intervals]; NaN where tasks differ in it",
    "first_frames": "for each task, frames since the start of its first block at the end of each of its intervals",
    "first_episodes": "for each task, finished episodes of these intervals",
    "first_success_rates": "for each task, share of them that reached the goal",
    "random_frames": "for each task, mean frames of the random policy until it first reaches the goal",
    "search_episodes": "for each task, E[kappa], the mean episodes of a search without repetition",
    "adaptation": "the last evaluation with adaptation on trained tasks, `Adaptation`",
    "held_out_adaptation": "the same on held-out tasks",
    "life": "a stream's life by blocks, `LifeCurves`",
    "regimes": "stays on one task, each a `Regime`, on the scale 1..101",
    "experts": "for each task, the training curves of its experts, on that scale",
    "areas": "each task's area under its curve over its own block, float64 [tasks]",
    "expert_areas": "the same of each task's expert",
    "trapezoid_areas": "as ``areas``, by trapezoids",
    "expert_trapezoid_areas": "as ``expert_areas``, by trapezoids",
}
"""By name; `ctgraph_rl.log.scores` gives them, or the reason why a run has none."""

OF_A_PART = ("episodes", "returns", "interval_best", "labelling", "life")
"""Those that a tuning run has, which ends after a part of the frames."""
