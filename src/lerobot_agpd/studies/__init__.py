"""Studies of trained policies: evaluation, comparisons, diversity, theory, and their tables and pictures."""
