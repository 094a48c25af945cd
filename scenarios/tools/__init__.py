"""Tools on top of runs: benchmarks, verification, checks of policies, viewing, data sets,
Gymnasium."""
