"""Dynamic scenes with exact answers, by analytic ray casting: training clips without end, and zest-bench."""
